"""What the panes are made of: their style, text, buttons and rows; and what runs beside them."""
