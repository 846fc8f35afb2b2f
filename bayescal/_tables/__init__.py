"""Files as tables: headers and cells as they stand, and what is wrong with them; nothing understood yet."""
