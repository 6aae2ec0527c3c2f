"""Results as files that other programs take: GeoParquet, GeoJSON, KML, CZML, GPX, Cursor on Target."""
