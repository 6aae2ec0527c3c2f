"""Tables of positions (CSV, Parquet, GeoJSON) as mission logs: columns are guessed, shown, and refused where in doubt."""
