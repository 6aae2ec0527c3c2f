"""What made a result: versions of this program and of the libraries that numbers depend on."""

import importlib.metadata


def versions() -> dict[str, str]:
    """Version by package name; "source" for this program when it runs from a checkout that is not installed."""
    found = {}
    for name in ("cadence", "torch", "numpy", "pyarrow", "mcap"):
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "source"
    return found
