"""What the page shows: the model, where it fails, what is missing, and below them the error and what is behind tabs."""
