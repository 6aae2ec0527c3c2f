"""Show the report of a log or of results."""

from collections.abc import Callable, Sequence
from pathlib import Path

from pipeline.batch.outcome import complaints, exit_code
from pipeline.progress import Progress
from pipeline.view.browser import open_page
from pipeline.view.pages import find_pages
from pipeline.view.server import serve


def view(
    target: str, out: str, path: Path | None, overrides: Sequence[str], progress: Progress, tell: Callable[[str], object],
    complain: Callable[[str], object], is_served: bool = False, port: int = 0, force: bool = False,
) -> int:  # fmt: skip
    """Run what `target` lacks and open its report; serve it where that is asked for, or where there is no browser.

    `tell` hears where the report is, `complain` why there is none. Returns the exit code: that of what had to be run.
    """
    found = find_pages(target, out, path, overrides, progress, force)
    outcomes = () if found.outcome is None else (found.outcome,)
    for line in complaints(outcomes):
        complain(line)
    code = exit_code(outcomes)
    if not found.pages:
        return code
    first = found.folder / found.pages[0]
    if is_served or len(found.pages) > 1 or not open_page(first):
        serve(found.folder, found.pages, port, tell)
    else:
        tell(f"opened {first}")
    return code
