"""Networks: the temporal U-Net and the encoder of detections."""
