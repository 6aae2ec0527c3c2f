"""Python runs this at each start while this folder is on PYTHONPATH."""

from line_marks import install

install()
