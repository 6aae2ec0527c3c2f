"""Which sources serve which role for one log: what the user states, and what the channels suggest for the rest."""

import fnmatch
import itertools
from collections.abc import Hashable, Mapping, Sequence

from cadence.errors import ConfigError, InputError, NothingDetectedError
from pipeline.extract.channel_reader import ChannelReader
from pipeline.extract.thinning import ThinningConfig
from pipeline.logs.reader import Channel
from pipeline.mapping.guess import SuggestedMapping, dense_sources, describe_channels, suggest_mapping, usable_type
from pipeline.mapping.sources import SourceConfig
from pipeline.suggestions import by_likeness, did_you_mean

ROLES = ("detections", "truth", "poses")
_OTHER_ROLES = ("truth", "poses", "tf", "obstacles")
"""Of channels that are known not to hold detections; many recorders write a channel only with its first message."""


Sources = Mapping[str, tuple[SourceConfig, ...]]
"""Sources by role: "detections", "truth", "poses"."""


def selected_channels(channels: Sequence[Channel], patterns: Sequence[str]) -> tuple[Channel, ...]:
    """The channels whose topic fits one of `patterns` (`*` stands for any characters); all of them without patterns.

    Raises `ConfigError` where a pattern fits none.
    """
    for pattern in patterns:
        if not any(fnmatch.fnmatchcase(channel.topic, pattern) for channel in channels):
            raise ConfigError(f"extract.topics: no topic of the log fits {pattern!r}{_meant(pattern, channels)}")
    return tuple(c for c in channels if not patterns or any(fnmatch.fnmatchcase(c.topic, pattern) for pattern in patterns))


def select_readers(
    stated: Sources, suggest: bool, thinning: ThinningConfig, channels: Sequence[Channel]
) -> tuple[ChannelReader, ...]:
    """A reader for every channel of every role; with `suggest`, the names of topics fill the roles that the user left empty.

    Raises `ConfigError` where a stated topic is not in the log or its schema needs paths, `InputError` where nothing can
    serve as detections, `NothingDetectedError` where the channels tell that nothing was detected; all name the channels and
    what to write.
    """
    suggested = suggest_mapping(channels)
    taken = _topics([source for sources in stated.values() for source in sources], channels)
    chosen = {role: stated[role] for role in ROLES}
    for role in ROLES:
        if suggest and not stated[role]:
            chosen[role] = _untaken(getattr(suggested, role), channels, taken)
    if thinning.enabled and thinning.thin_from == "truth":
        if not chosen["truth"]:
            # The only dense channel may have been stated as a pose: that is what pasting the suggested lines gives.
            chosen["truth"] = _dense(suggested, channels, _topics(stated["detections"], channels), bool(chosen["detections"]))
            chosen["poses"] = _untaken(chosen["poses"], channels, _topics(chosen["truth"], channels))
        chosen["detections"] = ()
    elif not chosen["detections"]:
        is_known = all(suggested.roles.get(channel.topic) in _OTHER_ROLES for channel in channels)
        failure = NothingDetectedError if is_known or _are_silent(suggested, channels) else InputError
        raise failure(_no_detections(suggested, channels))
    readers = []
    for role in ROLES:
        found = [_readers(role, source, chosen[role], bool(stated[role]), channels) for source in chosen[role]]
        readers += _once(list(itertools.chain.from_iterable(found)))
    return tuple(readers)


def _once(readers: Sequence[ChannelReader]) -> list[ChannelReader]:
    """One reader for what a channel says at the same paths: of patterns that overlap, that with fewest names is meant."""
    found: dict[Hashable, ChannelReader] = {}
    for reader in sorted(readers, key=lambda reader: reader.source.topic.count("{")):
        found.setdefault((reader.channel.id, reader.what), reader)
    return [reader for reader in readers if found[reader.channel.id, reader.what] is reader]


def unused_channels(readers: Sequence[ChannelReader], channels: Sequence[Channel]) -> dict[str, str]:
    """Why channels that may hold detections are read for no role, as `/topic (Type)` and the reason."""
    suggested, taken = suggest_mapping(channels), {reader.channel.id for reader in readers}
    is_stated = any(reader.role == "detections" and reader.is_stated for reader in readers)
    others = "[[extract.detections]] names others" if is_stated else "detections are thinned out of another channel"
    found = {}
    for channel in channels:
        why = suggested.unused.get(channel.topic)
        if why is None and suggested.roles.get(channel.topic) == "detections" and channel.message_count != 0:
            why = others
        if why is not None and channel.id not in taken:
            found[describe_channels([channel])] = why
    return found


def _topics(sources: Sequence[SourceConfig], channels: Sequence[Channel]) -> set[str]:
    return {channel.topic for channel in channels if any(source.match(channel.topic) is not None for source in sources)}


def _untaken(sources: tuple[SourceConfig, ...], channels: Sequence[Channel], taken: set[str]) -> tuple[SourceConfig, ...]:
    """The sources none of whose topics is `taken`."""
    return tuple(source for source in sources if not taken & _topics([source], channels))


def _dense(
    suggested: SuggestedMapping, channels: Sequence[Channel], taken: set[str], has_detections: bool
) -> tuple[SourceConfig, ...]:
    """The only position channel (or the channels of one pattern): what is thinned where no truth is named."""
    dense = _untaken(dense_sources(channels, suggested), channels, taken)
    if has_detections:
        raise InputError(
            "thinning: the log has detections but no truth to thin; name a dense channel under [[extract.truth]], or thin the "
            'detections with extract.thinning.thin_from = "detections"'
        )
    if len(dense) != 1:
        found = "several dense position channels" if dense else "no position channel that could be thinned"
        topics = ", ".join(source.topic for source in dense) or describe_channels(channels)
        raise InputError(f'thinning: {found}: {topics}; name one: [[extract.truth]] topic = "/..." (see cadence info)')
    return dense


def _readers(
    role: str, source: SourceConfig, sources: Sequence[SourceConfig], is_stated: bool, channels: Sequence[Channel]
) -> list[ChannelReader]:
    """A reader for every channel that `source`, one of `sources`, means."""
    named = [(channel, found) for channel in channels if (found := source.match(channel.topic)) is not None]
    if not named:
        raise ConfigError(
            f"extract.{role}: no topic of the log is {source.topic!r}{_meant(source.topic, channels)}; correct the entry"
        )
    return [
        ChannelReader(channel, source, role, is_stated, found)
        for channel, found in named
        if source.message_type in (None, usable_type(channel))
        or not _is_left_out(channel, source, sources, is_stated, channels)
    ]


def _is_left_out(
    channel: Channel, source: SourceConfig, sources: Sequence[SourceConfig], is_stated: bool, channels: Sequence[Channel]
) -> bool:
    """Whether a channel of another type than that of `source`, whose topic means it, is not for that source.

    Topics of several types may fit one pattern, and one topic may have several types. A type that the user states for another
    type is tried only where no channel is of its own type, and no other source is for the channel's.
    """
    own = usable_type(channel)
    is_for_others = any(
        usable_type(other) == source.message_type and source.match(other.topic) is not None for other in channels
    )
    return not is_stated or is_for_others or any(s.message_type == own and s.match(channel.topic) is not None for s in sources)


def _meant(topic: str, channels: Sequence[Channel]) -> str:
    """Which topic may have been meant, and what there is, the likeliest first."""
    by_topic = {channel.topic: channel for channel in channels}
    likely = [by_topic[name] for name in by_likeness(topic, by_topic)]
    return f"{did_you_mean(topic, by_topic)}; topics: {describe_channels(likely)}"


def _named(suggested: SuggestedMapping, channels: Sequence[Channel]) -> list[Channel]:
    """The channels whose names tell of detections."""
    return [channel for channel in channels if suggested.roles.get(channel.topic) == "detections"]


def _are_silent(suggested: SuggestedMapping, channels: Sequence[Channel]) -> bool:
    """Whether there are channels of detections, all of a known type, on which nothing was recorded."""
    named = _named(suggested, channels)
    return bool(named) and all(usable_type(channel) is not None for channel in named)


def _no_detections(suggested: SuggestedMapping, channels: Sequence[Channel]) -> str:
    """One line: what is there, and the lines that would make detections of it."""
    named = _named(suggested, channels)
    unread = sorted({channel.topic for channel in named if usable_type(channel) is None})
    if _are_silent(suggested, channels):
        return f"no message was recorded on {describe_channels(named)}; name other topics under [[extract.detections]]"
    if unread:
        paths = 'add [[extract.detections]] with topic, x = "path", y = "path" (or latitude, longitude)'
        return f"the types of {', '.join(unread)} are not known; {paths}; cadence info LOG prints the lines"
    return f"nothing looks like detections among {describe_channels(channels)}; {_advice(suggested, channels)}"


def _advice(suggested: SuggestedMapping, channels: Sequence[Channel]) -> str:
    """What to write where nothing looks like detections; never to take the truth, or where a sensor was, for them."""
    dense = () if suggested.truth else dense_sources(channels, suggested)
    if dense:
        entry = f'if it tells where targets are, add [[extract.detections]] with topic = "{dense[0].topic}"'
        entry += ", or make sparse detections of a dense channel with --set extract.thinning.enabled=true"
    else:
        entry = (
            'if one holds them, add [[extract.detections]] with topic = "/...", x = "path", y = "path" (or latitude, longitude)'
        )
    return f"{entry}; cadence info LOG prints the lines"
