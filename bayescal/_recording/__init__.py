"""How readings were recorded: what is set aside before a fit (clipped readings, spikes), rounding, Allan deviation."""
