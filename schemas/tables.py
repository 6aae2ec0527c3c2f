"""Arrow schemas of the files between the stages. Times int64 ns, positions float64 metres in the mission frame.

Every file carries the schema metadata keys `cadence.table`, `cadence.version` and `cadence.frame` (JSON: `frame_id`, the
name of the mission frame, and for georeferenced logs its datum, `latitude_deg` and `longitude_deg`, else null).
"""

import pyarrow as pa

VERSION = 1
"""Raised when a column changes meaning; readers refuse versions that they do not know."""
HEIGHT_VERSION = 2
"""Of tables with this column of heights; without it they are as they were, and say so."""
HEIGHT_COLUMNS = {"detections": "cov_zz_m2", "hypotheses": "height_m"}

DETECTIONS = pa.schema(
    [
        pa.field("log_id", pa.string(), nullable=False),
        pa.field("time_ns", pa.int64(), nullable=False),
        pa.field("sensor_id", pa.string()),
        pa.field("agent_id", pa.string()),  # null = origin unknown
        pa.field("x_m", pa.float64(), nullable=False),
        pa.field("y_m", pa.float64(), nullable=False),
        pa.field("z_m", pa.float64()),
        pa.field("cov_xx_m2", pa.float64()),  # null = exact up to the configured floor
        pa.field("cov_xy_m2", pa.float64()),
        pa.field("cov_yy_m2", pa.float64()),
        pa.field("score", pa.float32()),
        pa.field("num_merged", pa.int32(), nullable=False),  # simultaneous detections collapsed into this one
        pa.field("topic", pa.string(), nullable=False),  # provenance: topic + log time + sequence find the message
        pa.field("log_time_ns", pa.int64(), nullable=False),
        pa.field("sequence", pa.int64(), nullable=False),
    ]
)

DETECTIONS_WITH_HEIGHT = DETECTIONS.append(pa.field("cov_zz_m2", pa.float64()))  # null = exact up to a floor
"""Where heights are used: z_m is metres up from the vertical datum that the table's frame names, null where unknown."""

TRUTH = pa.schema(
    [
        pa.field("log_id", pa.string(), nullable=False),
        pa.field("time_ns", pa.int64(), nullable=False),
        pa.field("agent_id", pa.string(), nullable=False),
        pa.field("x_m", pa.float64(), nullable=False),
        pa.field("y_m", pa.float64(), nullable=False),
        pa.field("z_m", pa.float64()),
    ]
)

POSES = pa.schema(
    [
        pa.field("log_id", pa.string(), nullable=False),
        pa.field("time_ns", pa.int64(), nullable=False),
        pa.field("sensor_id", pa.string(), nullable=False),
        pa.field("x_m", pa.float64(), nullable=False),
        pa.field("y_m", pa.float64(), nullable=False),
        pa.field("z_m", pa.float64()),
    ]
)

LOOKS = pa.schema(
    [
        pa.field("log_id", pa.string(), nullable=False),
        pa.field("time_ns", pa.int64(), nullable=False),
        pa.field("sensor_id", pa.string(), nullable=False),
        pa.field("footprint", pa.int32(), nullable=False),  # number of an entry of sensors.json, from 0
        pa.field("part", pa.int32(), nullable=False),  # which of its curves holds
        pa.field("x_m", pa.float64(), nullable=False),
        pa.field("y_m", pa.float64(), nullable=False),
        pa.field("heading_rad", pa.float64(), nullable=False),  # from east to north; 0 where it faces nowhere
        pa.field("seen", pa.list_(pa.string()), nullable=False),  # agents that this look detected; a null: nobody knows whom
    ]
)
"""One row per look of a sensor whose footprint is stated, whether it detected anybody or not."""

MEASUREMENTS = pa.schema(
    [
        pa.field("log_id", pa.string(), nullable=False),
        pa.field("time_ns", pa.int64(), nullable=False),
        pa.field("sensor_id", pa.string()),
        pa.field("agent_id", pa.string()),  # null = nobody knows whom it is about
        pa.field("observer_x_m", pa.float64(), nullable=False),
        pa.field("observer_y_m", pa.float64(), nullable=False),
        pa.field("observer_z_m", pa.float64()),  # above the datum of the detections' heights; null where that is not known
        pa.field("observer_vx_mps", pa.float64()),
        pa.field("observer_vy_mps", pa.float64()),
        pa.field("bearing_rad", pa.float64()),  # from east towards north; what was not measured is null, and so is its sigma
        pa.field("bearing_sigma_rad", pa.float64()),
        pa.field("elevation_rad", pa.float64()),  # up from the horizontal
        pa.field("elevation_sigma_rad", pa.float64()),
        pa.field("range_m", pa.float64()),  # straight to the target
        pa.field("range_sigma_m", pa.float64()),
        pa.field("range_rate_mps", pa.float64()),  # positive where the target recedes
        pa.field("range_rate_sigma_mps", pa.float64()),
        pa.field("topic", pa.string(), nullable=False),  # topic, log time and sequence as in DETECTIONS
        pa.field("log_time_ns", pa.int64(), nullable=False),
        pa.field("sequence", pa.int64(), nullable=False),
    ]
)
"""One row per measurement of a target that is no position: a bearing, a range or a range rate, or both of too wide a beam."""

WINDOWS = pa.schema(
    [
        pa.field("window", pa.int32(), nullable=False),
        pa.field("origin_ns", pa.int64(), nullable=False),
        pa.field("agent_id", pa.string(), nullable=False),
        pa.field("status", pa.string(), nullable=False),
        pa.field("advice", pa.string()),
        pa.field("num_detections", pa.int32(), nullable=False),
        pa.field("age_s", pa.float64()),  # of the last detection at the origin; null without any
        pa.field("spread_m", pa.float64()),  # root mean square distance to the mean at the origin
        pa.field("probability", pa.float64()),  # that the agent is there; null: the origin of its detections is known
        pa.field("association_entropy_bits", pa.float64()),  # of who caused its detections; null as above
    ]
)
"""One row per window and agent, also where no hypothesis could be drawn."""

NUM_EFFECTIVE = pa.field("num_effective", pa.float64())
"""A column that WINDOWS have where the log holds evidence: the effective sample size of an agent's tracks; null where nothing
speaks of them."""

ASSOCIATIONS = pa.schema(
    [
        pa.field("log_id", pa.string(), nullable=False),
        pa.field("detection", pa.int64(), nullable=False),  # row of DETECTIONS, from 0
        pa.field("time_ns", pa.int64(), nullable=False),
        pa.field("topic", pa.string(), nullable=False),  # topic, log time and sequence as in DETECTIONS
        pa.field("log_time_ns", pa.int64(), nullable=False),
        pa.field("sequence", pa.int64(), nullable=False),
        pa.field("agent_id", pa.string()),  # null = clutter
        pa.field("first_window", pa.int32(), nullable=False),  # the first whose origin is not before the detection
        pa.field("first_probability", pa.float64(), nullable=False),  # that the agent caused it, as known in that window
        pa.field("probability", pa.float64(), nullable=False),  # the same as known in the last window
    ]
)
"""One row per detection of unknown origin and agent that may have caused it; only for logs that have such detections."""

LABELS = pa.schema(
    [
        pa.field("window", pa.int32(), nullable=False),
        pa.field("detection", pa.int64(), nullable=False),  # row of DETECTIONS, from 0
        pa.field("agent_id", pa.string()),  # null = clutter
    ]
)
"""One row per window and detection of unknown origin in it, under the likeliest association hypothesis.

The last window has a row for every detection so far, also for those before its beginning.
"""


PASTS = pa.schema(
    [
        pa.field("association", pa.int32(), nullable=False),
        pa.field("weight", pa.float64(), nullable=False),  # of the association; those of all sum to one
        pa.field("detection", pa.int64(), nullable=False),  # row of DETECTIONS, from 0
        pa.field("agent_id", pa.string()),  # null = clutter
    ]
)
"""One row per association hypothesis of the whole stream, as known in the last window, and detection of unknown origin.

Rows of an association are in order of time; the first association agrees most with all.
"""

MISSION = pa.schema(
    [
        pa.field("log_id", pa.string(), nullable=False),
        pa.field("block", pa.int32(), nullable=False),
        pa.field("agent_id", pa.string(), nullable=False),
        pa.field("hypothesis", pa.int32(), nullable=False),  # the same number is the same story in every block
        pa.field("weight", pa.float64(), nullable=False),
        pa.field("start_ns", pa.int64(), nullable=False),  # of the block's first step
        pa.field("step_ns", pa.int64(), nullable=False),
        pa.field("datum_x_m", pa.float64(), nullable=False),
        pa.field("datum_y_m", pa.float64(), nullable=False),
        pa.field("position_m", pa.list_(pa.list_(pa.float32(), 2)), nullable=False),
        pa.field("height_m", pa.list_(pa.float32())),  # null: nothing is known of it
    ]
)
"""One row per block of time, agent and mission hypothesis, in this order.

Step i of a block lies at start_ns + i * step_ns; blocks follow each other in time, each with a step of its own, as nobody needs
many steps where nothing is seen for long. position_m is relative to (datum_x_m, datum_y_m) in the mission frame; NaN where the
agent is not part of the hypothesis (yet, any more). An agent has rows in the blocks in which it is part of any hypothesis, and
then of all. Between two steps, also from one block to the next, a track is the straight line between its positions.
"""


def hypotheses_schema(num_steps: int, has_height: bool = False) -> pa.Schema:
    """HYPOTHESES: one row per window, hypothesis and agent (only agents with status ok or infeasible).

    Step i lies at origin_ns + (i - origin_index) * step_ns; position_m is [T, 2] float32 relative to the datum
    (datum_x_m, datum_y_m) in the mission frame. weight is that of the joint hypothesis: equal for all its agents. Where
    detections are of unknown origin, an agent need not be part of every hypothesis: NaN where it is not.
    height_m is [T] metres up from the vertical datum, null for agents of unknown height; only where heights are used.
    """
    height = [pa.field("height_m", pa.list_(pa.float32(), num_steps))] if has_height else []
    return pa.schema(
        [
            pa.field("log_id", pa.string(), nullable=False),
            pa.field("window", pa.int32(), nullable=False),
            pa.field("origin_ns", pa.int64(), nullable=False),
            pa.field("step_ns", pa.int64(), nullable=False),
            pa.field("origin_index", pa.int32(), nullable=False),
            pa.field("agent_id", pa.string(), nullable=False),
            pa.field("hypothesis", pa.int32(), nullable=False),
            pa.field("weight", pa.float32(), nullable=False),
            pa.field("datum_x_m", pa.float64(), nullable=False),
            pa.field("datum_y_m", pa.float64(), nullable=False),
            pa.field("position_m", pa.list_(pa.list_(pa.float32(), 2), num_steps), nullable=False),
            *height,
        ]
    )
