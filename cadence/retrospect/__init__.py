"""Mission hypotheses: joint tracks of a whole mission given all detections, by forward filter and backward draw."""
