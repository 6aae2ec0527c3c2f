"""Stage report: one self-contained HTML page a mission, which needs neither network nor server to be read."""
