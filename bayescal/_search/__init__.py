"""The posterior over structures: which effects and which noise law, how probable before and after the readings."""
