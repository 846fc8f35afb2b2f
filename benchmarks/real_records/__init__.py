"""What is found in measured records, and whether it holds on what was left out."""
