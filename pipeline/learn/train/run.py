"""Training: from a lake with table `training` to a run folder with checkpoints, metrics and the resolved config.

Source: paper section 4.5.4 for the recipe.
"""

from __future__ import annotations

import json
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path

from pipeline.core.results import Progress, silent
from pipeline.learn.prepare.inventory import require_sides
from pipeline.learn.train.loop import MetricsLog, TrainResult, run_loop, stop_signals
from pipeline.learn.train.processes import joined
from pipeline.learn.train.run_state import begin_run
from pipeline.learn.train.settings import TrainConfig
from pipeline.store.partitions import Lake

__all__ = ["TrainRequest", "train"]


@dataclass(frozen=True)
class TrainRequest:
    """Options of a training command in addition to the configuration.

    Args:
        data: folder of a lake with table `training`.
        out: folder of the run; an unfinished run in it continues.
        time_limit_s: duration after which this call stops with a checkpoint; None = no limit.
        start: run or exported file with the first weights of a new run; a continued run has its own.
    """

    data: str
    out: Path
    device: str = "auto"
    time_limit_s: float | None = None
    compiled: bool = False
    start: Path | None = None


def train(request: TrainRequest, config: TrainConfig, progress: Progress = silent) -> TrainResult:
    """Train, or continue training, until the run is finished, the time is up or a stop signal arrives.

    Raises:
        ConfigError: the run in `out` was begun with another configuration; no such device; `start` has
            another kind of network.
        ContractError: no training data, an empty side, or other data than at the start of the run; no trained
            weights in `start`.
        DivergedError: the loss is not finite or has grown too much; the last checkpoint is from before.
    """
    out = request.out
    require_sides(Lake.at(request.data))
    out.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        processes = stack.enter_context(joined(request.device))
        stops = stack.enter_context(stop_signals())
        run = begin_run(request.data, out, config, processes, compiled=request.compiled, start=request.start)
        stack.callback(run.stream.close)
        log: MetricsLog | None = None
        if processes.leads:
            (out / "train.json").write_text(json.dumps(config.model_dump(mode="json"), indent=1) + "\n")
            log = stack.enter_context(closing(MetricsLog(out, run.step)))
        return run_loop(run, out, log, stops, request.time_limit_s, progress)
