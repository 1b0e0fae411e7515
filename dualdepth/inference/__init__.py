"""From files to files: what `dualdepth predict` reads and writes."""
