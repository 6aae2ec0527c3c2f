"""Stage infer: detections to hypotheses."""
