"""How readings were recorded: what is set aside before a fit (clipped readings, spikes), and rounding."""
