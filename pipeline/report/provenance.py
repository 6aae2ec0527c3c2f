"""What made the result, and how to make it again."""

import shlex
from html import escape

from pipeline.report.markup import as_toml, flatten, label, pairs, section, text
from pipeline.report.mission import JsonDict, Mission

MODEL_WORDS = ("seed", "checkpoint", "preset", "estimator", "device")
"""Settings and results of infer that are named with the source; the rest is folded away."""


def provenance_section(mission: Mission) -> str:
    """Command, settings, hashes and versions, folded away."""
    parts = [_repeat(mission), _source(mission)]
    parts += [_stage(stage, manifest) for stage, manifest in mission.manifests.items()]
    return section("Settings and provenance", f"<details><summary>Show</summary>{''.join(parts)}</details>")


def _repeat(mission: Mission) -> str:
    configs = {stage: manifest.get("config") for stage, manifest in mission.manifests.items() if stage != "evaluate"}
    toml = as_toml({stage: config for stage, config in configs.items() if isinstance(config, dict) and config})
    command = f"cadence run {shlex.quote(mission.log)} --out results --config repeat.toml"
    return (
        f"<h3>To repeat this run</h3><p>Save the settings below as repeat.toml, then:</p><pre>{text(command)}</pre>"
        f"<details><summary>repeat.toml</summary><pre>{escape(toml)}</pre></details>"
    )


def _source(mission: Mission) -> str:
    rows = [("log", text(mission.log)), ("SHA-256 of the log", f"<code>{text(mission.catalogue.sha256)}</code>")]
    infer = mission.manifests.get("infer", {})
    for key, value in dict([*flatten(infer.get("config", {})), *flatten(infer.get("summary", {}))]).items():
        if any(word in key for word in MODEL_WORDS):
            rows.append((label(key), f"<code>{text(value)}</code>"))
    frame = mission.frame.frame_id
    if mission.frame.is_georeferenced:
        frame += f", datum {mission.frame.latitude_deg}, {mission.frame.longitude_deg}"
    return f"<h3>Source and model</h3>{pairs([*rows, ('mission frame', text(frame))])}"


def _stage(stage: str, manifest: JsonDict) -> str:
    versions = ", ".join(f"{name} {version}" for name, version in sorted(dict(manifest.get("versions") or {}).items()))
    summary = pairs((label(key), text(value)) for key, value in flatten(manifest.get("summary") or {}))
    hashes = [
        (f"{kind}: {text(name)}", f"<code>{text(digest)}</code>")
        for kind in ("inputs", "outputs")
        for name, digest in sorted(dict(manifest.get(kind) or {}).items())
    ]
    inner = f"<p>Versions: {text(versions)}</p>{summary}<h3>SHA-256</h3>{pairs(hashes)}"
    return f"<details><summary>Stage {text(stage)}</summary>{inner}</details>"
