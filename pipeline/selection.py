"""Which sources serve which role for one log: what the user states, and what the channels suggest for the rest."""

from collections.abc import Sequence
from dataclasses import dataclass

from cadence.errors import ConfigError, InputError
from pipeline.logs.reader import Channel
from pipeline.mapping import SuggestedMapping, dense_sources, describe_channels, suggest_mapping
from pipeline.positions import ChannelReader
from pipeline.sources import SourceConfig
from pipeline.thinning import ThinningConfig

STATED_ROLES = ("detections", "truth", "poses")


@dataclass(frozen=True)
class Stated:
    """The user's `[extract]` sources of each role; `suggest` lets the names of topics fill the roles left empty."""

    detections: tuple[SourceConfig, ...]
    truth: tuple[SourceConfig, ...]
    poses: tuple[SourceConfig, ...]
    suggest: bool
    thinning: ThinningConfig


def select_readers(stated: Stated, channels: Sequence[Channel]) -> tuple[ChannelReader, ...]:
    """A reader for every channel of every role.

    Raises `ConfigError` where a stated topic is not in the log or its schema needs paths, `InputError` where nothing can
    serve as detections; both name the channels and what to write.
    """
    suggested = suggest_mapping(channels)
    taken = {c.topic for role in STATED_ROLES for source in getattr(stated, role) for c in channels if source.match(c.topic) is not None}
    chosen = {role: _sources(role, stated, suggested, channels, taken) for role in STATED_ROLES}
    thins_truth = stated.thinning.enabled and stated.thinning.thin_from == "truth"
    if thins_truth:
        if not chosen["truth"]:
            chosen["truth"] = _dense(suggested, channels, taken, bool(chosen["detections"]))
            dense = {c.topic for c in channels if any(source.match(c.topic) is not None for source in chosen["truth"])}
            chosen["poses"] = tuple(s for s in chosen["poses"] if not any(s.match(topic) is not None for topic in dense))
        chosen["detections"] = ()
    elif not chosen["detections"]:
        raise InputError(_no_detections(suggested, channels))
    return tuple(
        reader for role in STATED_ROLES for source in chosen[role]
        for reader in _readers(role, source, bool(getattr(stated, role)), channels)
    )  # fmt: skip


def _sources(
    role: str, stated: Stated, suggested: SuggestedMapping, channels: Sequence[Channel], taken: set[str]
) -> tuple[SourceConfig, ...]:
    sources: tuple[SourceConfig, ...] = getattr(stated, role)
    if sources or not stated.suggest:
        return sources
    found: tuple[SourceConfig, ...] = getattr(suggested, role)
    return tuple(s for s in found if not any(s.match(topic) is not None for topic in taken))


def _dense(
    suggested: SuggestedMapping, channels: Sequence[Channel], taken: set[str], has_detections: bool
) -> tuple[SourceConfig, ...]:
    """The only position channel (or the channels of one pattern): what is thinned where no truth is named."""
    dense = tuple(s for s in dense_sources(channels, suggested) if not any(s.match(topic) is not None for topic in taken))
    if has_detections:
        raise InputError(
            "thinning: the log has detections but no truth to thin; name a dense channel under [[extract.truth]], or thin the "
            'detections with extract.thinning.thin_from = "detections"'
        )
    if len(dense) != 1:
        found = "several dense position channels" if dense else "no position channel that could be thinned"
        topics = ", ".join(source.topic for source in dense) or describe_channels(channels)
        raise InputError(f"thinning: {found}: {topics}; name one: [[extract.truth]] topic = \"/...\" (see cadence info)")
    return dense


def _readers(role: str, source: SourceConfig, is_stated: bool, channels: Sequence[Channel]) -> list[ChannelReader]:
    named = [(channel, found) for channel in channels if (found := source.match(channel.topic)) is not None]
    if not named:
        raise ConfigError(
            f"extract.{role}: no topic of the log is {source.topic!r}; topics: {describe_channels(channels)}; correct the entry"
        )
    return [ChannelReader(channel, source, role, is_stated, found) for channel, found in named]


def _no_detections(suggested: SuggestedMapping, channels: Sequence[Channel]) -> str:
    """One line: what is there, and the lines that would make detections of it."""
    unread = [topic for topic, role in suggested.roles.items() if role == "detections"]
    if unread:
        paths = 'add [[extract.detections]] with topic, x = "path", y = "path" (or latitude, longitude)'
        return f"no preset knows the schema of {', '.join(unread)}; {paths}; cadence info LOG prints the lines"
    dense = [source.topic for role in ("truth", "poses", "positions") for source in getattr(suggested, role)]
    advice = f"add [[extract.detections]] with topic = {dense[0] if dense else '/...'!r}"
    advice += " and its message paths" if not dense else ", or thin the dense channel with --set extract.thinning.enabled=true"
    return f"nothing looks like detections among {describe_channels(channels)}; {advice}; cadence info LOG prints the lines"
