"""Tracks that bearings and ranges tell of, with few positions or none: joint samples of the bank's posterior.

`linear` makes measurements linear near a supposed track, `profiles` supposes tracks at several ranges, `cells` smooths one
motion model about each, `draws` weighs samples to the exact likelihood and moves them where few count, `estimator` wraps any
estimator.
"""
