"""Which agent caused which detection, where the log does not say: weighted ways to read one stream of detections.

`types` holds what goes in and comes out.
"""
