"""Where on the earth a mission is, in words: who was there sees whether latitude and longitude are the right way round."""


def place_words(latitude_deg: float | None, longitude_deg: float | None) -> str:
    """As `48.1000° N, 11.6000° E`; empty where it is not known."""
    if latitude_deg is None or longitude_deg is None:
        return ""
    north, east = "S" if latitude_deg < 0 else "N", "W" if longitude_deg < 0 else "E"
    return f"{abs(latitude_deg):.4f}° {north}, {abs(longitude_deg):.4f}° {east}"
