"""One scale for log Bayes factors, natural logarithm: Kass & Raftery, J. Am. Stat. Assoc. 90 (1995) 773."""

STRONG = 3.0  # nats: odds of twenty
VERY_STRONG = 5.0  # nats: odds of a hundred and fifty
