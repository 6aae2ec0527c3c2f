"""`cadence view`: the report of a log or of results, in a browser or served to this machine alone."""
