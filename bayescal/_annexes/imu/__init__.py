"""Three-axis sensors: poses and moves, body frame, corrections of a triad, and their files for other programs."""
