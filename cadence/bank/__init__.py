"""The bank: closed-form smoothers of many motion models, weighted by how well each explains the detections.

`components` lists the motion models, `smoother` filters, smooths and draws joint samples for one model a row, and
`bank` weighs the models by expectation maximisation and mixes them.
"""
