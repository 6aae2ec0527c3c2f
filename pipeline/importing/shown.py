"""What a table was taken for, as text."""

from pipeline.counted import counted
from pipeline.importing.stage import Imported
from pipeline.logs.reader import utc

_HEADINGS = ("what", "column", "taken as", "said by", "for example")
_MAX_UNUSED = 12
_MAX_EXAMPLE = 32


def render(imported: Imported) -> str:
    """The table of columns, what was left out and noticed, and the next command."""
    provider = f" ({imported.provider})" if imported.provider else ""
    rows = [(each.field, each.column, each.taken, each.by, each.example[:_MAX_EXAMPLE]) for each in imported.columns]
    widths = [max(len(row[index]) for row in [_HEADINGS, *rows]) for index in range(len(_HEADINGS))]
    lines = [f"{imported.table}: {imported.kind}{provider}, {imported.num_rows} rows"]
    lines += [
        "  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in [_HEADINGS, *rows]
    ]
    if imported.unused:
        rest = f" and {len(imported.unused) - _MAX_UNUSED} more" if len(imported.unused) > _MAX_UNUSED else ""
        lines.append(f"  not used: {', '.join(imported.unused[:_MAX_UNUSED])}{rest}")
    lines += [f"left out: {number} {reason}" for reason, number in imported.left_out.items()]
    lines += [f"note: {note}" for note in imported.notes]
    if not imported.num_agents:
        lines.append("note: nothing says who was seen, so it will be found out; --agent NAME where all rows are of one")
    truth = f" and {imported.num_truth} rows of truth" if imported.num_truth else ""
    agents = f" of {counted(imported.num_agents, 'agent')}" if imported.num_agents else ""
    lines.append(f"{imported.num_detections} detections{agents}{truth}, {utc(imported.start_ns)} to {utc(imported.end_ns)}")
    if imported.log is None:
        lines.append("nothing was written; if this is right, give --out LOG.mcap; else say it with --column FIELD=COLUMN")
    else:
        lines.append(f"wrote {imported.log}; next: cadence run {imported.log} --out results")
    return "\n".join(lines)
