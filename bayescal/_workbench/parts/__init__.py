"""What the panes are made of: their style, text, buttons and rows, what runs beside them, which readings are drawn."""
