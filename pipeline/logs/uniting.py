"""Several recordings as one mission: their channels become one where topic, encodings and schema are the same."""

from collections import Counter
from collections.abc import Hashable, Sequence
from dataclasses import replace

from pipeline.logs.channels import Channel
from pipeline.logs.timeline import Source


def unite(sources: Sequence[Source]) -> tuple[tuple[Source, ...], tuple[Channel, ...]]:
    """The sources with the channels of the mission instead of their own, and all channels by id, which are unique.

    A recording may have several channels of one topic and schema; they stay apart.
    """
    channels: dict[Hashable, Channel] = {}
    taken: set[int] = set()
    keys: list[dict[int, Hashable]] = []
    for source in sources:
        repeated: Counter[Hashable] = Counter()
        keys.append({})
        for number, channel in source.channels.items():
            kind = (channel.topic, channel.message_encoding, channel.schema_name, channel.schema_encoding, channel.schema_data)
            repeated[kind] += 1
            key = keys[-1][number] = (kind, repeated[kind])
            if key in channels:
                count = (channels[key].message_count or 0) + (channel.message_count or 0)
                channels[key] = replace(channels[key], message_count=count)
            else:
                channels[key] = replace(channel, id=max(taken) + 1) if number in taken else channel
                taken.add(channels[key].id)
    united = (
        replace(source, channels={number: channels[key] for number, key in own.items()})
        for source, own in zip(sources, keys, strict=True)
    )
    return tuple(united), tuple(sorted(channels.values(), key=lambda channel: channel.id))
