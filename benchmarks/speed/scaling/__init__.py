"""What computing costs, and how the cost grows with the readings."""
