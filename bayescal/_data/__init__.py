"""From a table to `Measurements`: headers, units, checked columns; then averages, spikes, the Allan deviation."""
