"""Height beside the plane: a bank of modes of vertical motion that may change at every detection, in closed form.

`modes` are the ways to change height, `filtering` weighs them by the detections, `draws` samples jointly, `fitting` learns
weights from a log, `noise` tells how exact heights are, and `bank` draws heights beside the hypotheses of any estimator.
"""
