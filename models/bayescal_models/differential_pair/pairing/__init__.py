"""Choice of the two devices of a pair, with probabilities, and the measurement by that pair."""
