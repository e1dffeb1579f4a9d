"""Measures from research on flocks and crowds, a family per file: functions of arrays, or of one world.

`flockenv measure SCENE.yaml` runs a scene and shows the measures that apply to it; docs/measures.md describes
each.
"""

from __future__ import annotations

from flockenv.studies.measures.chance import Above, Mean, above_null, mean_of_runs
from flockenv.studies.measures.clogging import Tail, goodness, survival, tail
from flockenv.studies.measures.density import (
    Ground,
    Room,
    classical_density,
    speed_in_area,
    voronoi,
    voronoi_density,
    voronoi_speed,
)
from flockenv.studies.measures.door_bursts import Bursts, bursts, runs
from flockenv.studies.measures.evacuation import evacuation_time, last_crossing, leaving_times
from flockenv.studies.measures.fundamental import (
    JUELICH,
    diagram,
    juelich_share,
    required_length,
    single_file_density,
    single_file_speed,
    weidmann_deviation,
    weidmann_flow,
    weidmann_speed,
)
from flockenv.studies.measures.instant import MEASURES, measure
from flockenv.studies.measures.lane_formation import Lanes, band_index, lane_order, lanes
from flockenv.studies.measures.order import (
    cohesion_radius,
    components,
    group_momentum,
    milling,
    nearest_distances,
    polarisation,
)
from flockenv.studies.measures.proportions import (
    Proportion,
    collision_rate,
    oscillation_proportion,
    overlap_area,
    overlap_proportion,
)
from flockenv.studies.measures.throughput import Crossings, Flow, crossings, cumulative, flow, time_gaps

__all__ = [
    "JUELICH",
    "MEASURES",
    "Above",
    "Bursts",
    "Crossings",
    "Flow",
    "Ground",
    "Lanes",
    "Mean",
    "Proportion",
    "Room",
    "Tail",
    "above_null",
    "band_index",
    "bursts",
    "classical_density",
    "cohesion_radius",
    "collision_rate",
    "components",
    "crossings",
    "cumulative",
    "diagram",
    "evacuation_time",
    "flow",
    "goodness",
    "group_momentum",
    "juelich_share",
    "lane_order",
    "lanes",
    "last_crossing",
    "leaving_times",
    "mean_of_runs",
    "measure",
    "milling",
    "nearest_distances",
    "oscillation_proportion",
    "overlap_area",
    "overlap_proportion",
    "polarisation",
    "required_length",
    "runs",
    "single_file_density",
    "single_file_speed",
    "speed_in_area",
    "survival",
    "tail",
    "time_gaps",
    "voronoi",
    "voronoi_density",
    "voronoi_speed",
    "weidmann_deviation",
    "weidmann_flow",
    "weidmann_speed",
]  # fmt: skip
