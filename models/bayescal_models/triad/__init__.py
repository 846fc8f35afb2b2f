"""What the instruments of three axes share: the equation, its slots, effects on families of them, and poses."""
