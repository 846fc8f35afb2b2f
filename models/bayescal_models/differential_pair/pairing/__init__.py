"""Selection of the two devices of a differential pair, with probabilities, and measurement with the pair."""
