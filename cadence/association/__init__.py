"""Which agent caused which detection, where the log does not say: weighted association hypotheses of one stream.

`types` holds what goes in and comes out; `associate` runs the filter of `particles` over a stream and reads it at every
window origin, with agents named by `naming`. `motion`, `tracks` and `presence` say what is expected of the next detection,
`resampling` keeps the hypotheses few, and `fitting` finds what is typical of a stream; `counts` says what it turned out to be.
"""
