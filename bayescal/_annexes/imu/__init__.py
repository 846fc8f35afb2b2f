"""Three axes: poses and moves, one body frame, corrections of a triad, and the files that others read of it."""
