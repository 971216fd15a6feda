"""Two tables of wide rows with a file per partition, for the tests of what reads and writes any such table."""

from schemas.captures import ImageColumns, ScanColumns, SweepColumns
from schemas.columns import column, row, table_of
from schemas.features import ImageFeatureColumns, ScanFeatureColumns, SweepFeatureColumns
from schemas.moments import EgoColumns


@row()
class WholeFrame(ImageColumns, SweepColumns, ScanColumns, EgoColumns):
    """What three sensors measured, in one row."""

    frame_index: int = column("which", kind="int32")
    log: str = column("file name of the log")
    drive: int = column("which drive", kind="int32")
    stamp_ns: int = column("when")


@row()
class WholeObservation(ImageFeatureColumns, SweepFeatureColumns, ScanFeatureColumns):
    """What three sensors show, in one row."""

    frame_index: int = column("which", kind="int32")
    stamp_ns: int = column("when")


FRAMES = table_of(WholeFrame, "frames", 2, made_by="ingest")
OBSERVATIONS = table_of(WholeObservation, "observations", 2, made_by="perceive")
