"""One self-contained HTML page of what was done to a frame, to a shot, or of what each second buys.

A room of its own: plain values and arrays go in, a string comes out. The page needs no network, and a policy in its
head forbids it any; images are linear radiance as half floats, exposed and tone mapped where they are looked at.
"""

from selfcorrect.report.bench import bench_page
from selfcorrect.report.frame import frame_page
from selfcorrect.report.pack import LARGEST_PAGE, shrunk
from selfcorrect.report.shot import ShotFrame, shot_page, slice_of, still, thumbnail

__all__ = [
    "LARGEST_PAGE",
    "ShotFrame",
    "bench_page",
    "frame_page",
    "shot_page",
    "shrunk",
    "slice_of",
    "still",
    "thumbnail",
]
