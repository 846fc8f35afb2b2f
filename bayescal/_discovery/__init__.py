"""Which effect is missing, as it is told: candidates, the loop with its path, the next experiment."""
