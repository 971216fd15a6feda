"""Two tables of wide rows with a file per partition, for the tests of what reads and writes any such table."""

from schemas.captures import ImageColumns, ScanColumns, SweepColumns
from schemas.columns import TableSchema, column, row
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


FRAMES = TableSchema(WholeFrame, "frames", 2, made_by="ingest")
OBSERVATIONS = TableSchema(WholeObservation, "observations", 2, made_by="perceive")
