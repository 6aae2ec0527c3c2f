"""Evidence: what speaks about whole tracks beside positions, and the weighing of hypotheses by it.

`estimator` wraps any estimator: draw, weigh, look at the effective sample size, draw more where it is small. `weights` asks the
evidence and sets aside what contradicts every hypothesis; `choosing` takes few weighted hypotheses out of many.
"""
