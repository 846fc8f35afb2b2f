"""What the page shows, a file each: the model, where it fails, what is missing, the error, and what is behind tabs."""
