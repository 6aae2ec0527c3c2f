"""How exact detections are that do not say so: their noise in position and in time, by their own likelihood.

`processes` lists the ways to move that may explain them, `likelihood` filters stretches of tracks under all of them at once,
`courses` says how fast a target went where it was detected, and `noise` finds the noise of greatest likelihood.
`polar` makes positions of ranges and bearings.
"""
