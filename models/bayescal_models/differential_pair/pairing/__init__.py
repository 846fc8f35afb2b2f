"""Which two devices make the pair, with probabilities, and what the pair then measures."""
