"""Which agent caused which detection, where the log does not say: weighted ways to read one stream of detections.

`types` holds what goes in and comes out; `associate` runs the filter of `particles` over a stream and reads it at every
window origin, with agents named by `naming`. `motion`, `tracks` and `presence` say what is expected of the next detection,
`resampling` keeps the ways few, and `fitting` finds what is typical of a stream.
"""
