"""What of the log can hardly be meant as it stands: before everything that rests on it."""

from pipeline.report.markup import section, table, text
from pipeline.report.mission import Mission

_COLUMNS = {
    "kind": "kind", "subject": "of", "seen": "what does not fit", "done": "what was done", "setting": "to decide otherwise",
}  # fmt: skip


def suspicions_section(mission: Mission) -> str:
    """A row a suspicion of the stages; nothing where they have none."""
    if not mission.suspicions:
        return ""
    rows = [[text(record.get(name, "")) for name in _COLUMNS] for record in mission.suspicions]
    lead = "This can hardly be meant as it stands. All that follows rests on what was made of it."
    content = f'<div class="problem">{table(list(_COLUMNS.values()), rows)}</div>'
    return section("What is suspected", content, lead)
