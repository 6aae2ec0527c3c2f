"""Stage extract: log and catalogue to tables of detections, truth, poses and obstacles."""
