"""Train a network on a folder of views.

    .venv/bin/python scripts/train/train.py denoiser --data DATASET --out RUN --minutes 45 [--batch 8] [--threads 1]
    .venv/bin/python scripts/train/train.py deep-combiner --width 32 --kernel 3 --data DATASET --out RUN --steps 5000

Networks: denoiser, james-stein, bilateral-combiner, deep-combiner, deep-combiner-4; what each is shown and its loss:
``tasks.py``. AdamW, a short warm-up, then a cosine to 0 over the steps or minutes given; bf16 autocast where the
processor has it; an exponential mean of the weights is what is validated and exported. Targets are noisy, and their
fireflies are not clamped: where the gradient's norm is over twice its running geometric mean, it is scaled down to
that. That bounds what one firefly does, and darkens a little: the column radiance of the validation says how much.

``--hold-out NAME`` trains on no view of that scene and validates on those alone; ``--at-most N`` trains on N views,
evenly out of all: several runs are a learning curve.

RUN gets ``checkpoint.pt`` (every minute, under a temporary name first), ``losses.csv`` (each step), ``validation.csv``
(every five minutes, with clean references) and ``curves.png``. The same command goes on where a killed one was; with
``--steps``, with the losses of an unbroken run: each batch is a function of the seed and its number alone.
"""

import argparse
import copy
import csv
import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import dataset
import matplotlib as mpl
import torch
from samples import Memory, Sample, collate
from tasks import TASKS, Task, task_of
from torch import nn

from selfcorrect import metrics
from selfcorrect.stages.tiled import autocast

mpl.use("Agg")
import matplotlib.pyplot as plt

WARM_UP = 0.02  # of the budget
EMA = 0.999
LIMIT = 2.0  # of the running geometric mean of the gradient's norm
MEMORY = 0.02  # of that mean: some 50 steps
ARCHITECTURE = ("width", "window", "layers", "kernel", "anchored")

LOSS_COLUMNS = ("step", "seconds", "loss", "gradient", "rate")
VALIDATION_COLUMNS = ("step", "seconds", "relmse", "to_baseline", "to_noisy", "worst_to_noisy", "radiance")


@dataclass
class Run:
    """All that changes in training, and what a checkpoint holds."""

    network: nn.Module
    mean: nn.Module
    optimiser: torch.optim.Optimizer
    step: int = 0
    seconds: float = 0.0
    typical_gradient: float = 0.0
    losses: list[tuple[float, ...]] = field(default_factory=list)
    validations: list[tuple[float, ...]] = field(default_factory=list)

    def state(self) -> dict[str, Any]:
        """Plain values and tensors."""
        modules = {"network": self.network, "mean": self.mean, "optimiser": self.optimiser}
        return {name: module.state_dict() for name, module in modules.items()} | {
            name: getattr(self, name) for name in ("step", "seconds", "typical_gradient", "losses", "validations")
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Take over what :meth:`state` gave."""
        for name, value in state.items():
            if name in ("network", "mean", "optimiser"):
                getattr(self, name).load_state_dict(value)
            else:
                setattr(self, name, value)


def main(arguments: list[str] | None = None) -> None:
    options = parse(arguments)
    torch.set_num_threads(options.threads)
    options.out.mkdir(parents=True, exist_ok=True)
    files = files_of(options)
    settings = settings_of(options, dataset.checksum(files["train"]))
    task = task_of(options.network, settings["architecture"], options.seed, options.crop)
    run = begin(task, options)
    checkpoint = options.out / "checkpoint.pt"
    if checkpoint.exists():
        saved = torch.load(checkpoint, weights_only=True)
        if saved["settings"] != settings:
            raise SystemExit(
                f"{checkpoint}: expected the run {settings}, but got {saved['settings']}; use another --out"
            )
        run.restore(saved["run"])
        print(f"goes on at step {run.step}", flush=True)
    memories = [Memory.of(dataset.load(path)) for path in files["train"]]
    held_out = [dataset.load(path) for path in files["validation"][: options.validation_views]]
    print(f"{len(memories)} views, {len(held_out)} for validation, {count(run.network)} parameters", flush=True)

    def save() -> None:
        publish(checkpoint, lambda path: torch.save({"settings": settings, "run": run.state()}, path))
        write_csv(options.out / "losses.csv", LOSS_COLUMNS, run.losses)
        write_csv(options.out / "validation.csv", VALIDATION_COLUMNS, run.validations)

    train(run, task, memories, held_out, options, save)
    draw_curves(run, task.baseline, options.out / "curves.png")


def files_of(options: argparse.Namespace) -> dict[str, list[Path]]:
    """The views to train on and to validate on."""
    files = {part: dataset.views(options.data / part) for part in ("train", "validation")}
    if options.hold_out:
        scenes = {path: dataset.metadata_of(path)["scene"] for paths in files.values() for path in paths}
        files["train"] = [path for path in files["train"] if scenes[path] != options.hold_out]
        files["validation"] = [path for path in files["validation"] if scenes[path] == options.hold_out]
    count = min(options.at_most or len(files["train"]), len(files["train"]))
    files["train"] = [files["train"][i * len(files["train"]) // count] for i in range(count)]
    if not files["train"]:
        raise SystemExit(f"{options.data / 'train'}: expected views (*.safetensors), but found none")
    return files


def settings_of(options: argparse.Namespace, checksum: str) -> dict[str, Any]:
    """What decides the result, for the checkpoint and the weights' metadata."""
    names = ("network", "steps", "minutes", "batch", "crop", "lr", "weight_decay", "seed", "threads")
    given = {name: getattr(options, name) for name in ARCHITECTURE}
    return {
        **{name: getattr(options, name) for name in names},
        "architecture": {name: value for name, value in given.items() if value is not None},
        "data": checksum,
        "initial": provenance(options.initial) if options.initial else None,
    }


def provenance(run: Path) -> dict[str, Any]:
    """What made the weights of a run that another one starts from."""
    saved = torch.load(run / "checkpoint.pt", weights_only=True)
    return {**saved["settings"], "hours": round(saved["run"]["seconds"] / 3600, 3), "steps": saved["run"]["step"]}


def begin(task: Task, options: argparse.Namespace) -> Run:
    """A run before its first step."""
    network = task.build()
    if options.initial:
        network.load_state_dict(torch.load(options.initial / "checkpoint.pt", weights_only=True)["run"]["mean"])
    optimiser = torch.optim.AdamW(network.parameters(), options.lr, weight_decay=options.weight_decay)
    return Run(network, copy.deepcopy(network).eval(), optimiser)


def train(
    run: Run,
    task: Task,
    memories: list[Memory],
    held_out: list[dataset.View],
    options: argparse.Namespace,
    save: Callable[[], None],
) -> None:
    """Optimise to the end of the budget, with checkpoints and validations on the way."""
    begun = time.perf_counter() - run.seconds
    saved = time.perf_counter()
    while (progress := progress_of(run, options)) < 1:
        optimise(run, task, batch_of(run.step, task, memories, options), rate(progress, options.lr))
        run.seconds = time.perf_counter() - begun
        since = run.seconds - (run.validations[-1][1] if run.validations else 0)
        if held_out and since > 60 * options.validate_minutes:
            validate(run, task, held_out)
            draw_curves(run, task.baseline, options.out / "curves.png")
        if time.perf_counter() - saved > options.checkpoint_seconds:
            save()
            saved = time.perf_counter()
        run.seconds = time.perf_counter() - begun
    if held_out:
        validate(run, task, held_out)
    save()


def progress_of(run: Run, options: argparse.Namespace) -> float:
    """Share of the budget that is spent."""
    return run.step / options.steps if options.steps else run.seconds / (60 * options.minutes)


def rate(progress: float, highest: float) -> float:
    """The learning rate: a linear warm-up, then a cosine."""
    return highest * min(1, (progress + 1e-3) / WARM_UP) * 0.5 * (1 + math.cos(math.pi * progress))


def batch_of(step: int, task: Task, memories: list[Memory], options: argparse.Namespace) -> Sample:
    """The batch of this number."""
    generator = torch.Generator().manual_seed((options.seed << 32) + step)
    numbers = torch.randint(len(memories), (options.batch,), generator=generator).tolist()
    return collate([task.sample(number, memories[number], generator) for number in numbers])


def optimise(run: Run, task: Task, batch: Sample, rate: float) -> None:
    """One step."""
    run.network.train()
    with autocast(batch.target, "bf16"):
        losses = task.losses(run.network, batch)
    loss = losses.float().mean()
    run.optimiser.zero_grad()
    loss.backward()
    limit = LIMIT * run.typical_gradient if run.step else math.inf
    norm = float(nn.utils.clip_grad_norm_(run.network.parameters(), limit))
    if not math.isfinite(norm):
        raise SystemExit(f"step {run.step}: expected a finite gradient, but got {norm}; try a lower --lr")
    counted = min(norm, limit)
    run.typical_gradient = run.typical_gradient ** (1 - MEMORY) * counted**MEMORY if run.step else counted
    for group in run.optimiser.param_groups:
        group["lr"] = rate
    run.optimiser.step()
    kept = min(EMA, (1 + run.step) / (10 + run.step))
    with torch.no_grad():
        for mean, weight in zip(run.mean.parameters(), run.network.parameters(), strict=True):
            mean.lerp_(weight, 1 - kept)
    run.losses.append((run.step, run.seconds, float(loss.detach()), norm, rate))
    run.step += 1


@torch.no_grad()
def validate(run: Run, task: Task, views: list[dataset.View]) -> None:
    """Geometric means over the views, in float32, and the ratio of the mean radiance to the reference's."""
    errors = []
    radiance = []
    for view in views:
        assert view.reference is not None  # a view for validation has one
        references = (view.reference[0], view.reference[1], view.smooth)
        for judged in task.judge(run.mean, view):
            errors.append([max(metrics.relmse(image, *references), 1e-5) for image in judged])
            radiance.append(metrics.mean_radiance_ratio(judged.result, view.reference.mean(0)))
    result, baseline, noisy = torch.tensor(errors, dtype=torch.float64).log().unbind(1)
    row = (result, result - baseline, result - noisy)
    worst = float((result - noisy).max().exp())
    values = [float(column.mean().exp()) for column in row]
    shown = (run.step, run.seconds, *values, worst, float(torch.tensor(radiance).median()))
    run.validations.append(shown)
    print("  ".join(f"{n} {v:.4g}" for n, v in zip(VALIDATION_COLUMNS, shown, strict=True)), flush=True)


def publish(path: Path, write: Callable[[Path], object]) -> None:
    """Write under a temporary name, then rename: a kill leaves the last one whole."""
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    write(temporary)
    os.replace(temporary, path)


def write_csv(path: Path, columns: tuple[str, ...], rows: list[tuple[float, ...]]) -> None:
    def write(temporary: Path) -> None:
        with temporary.open("w", newline="") as file:
            csv.writer(file).writerows([columns, *rows])

    publish(path, write)


def draw_curves(run: Run, baseline: str, path: Path) -> None:
    """Loss (a running mean) and validation over the minutes."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    minutes = [row[1] / 60 for row in run.losses]
    smooth, mean = [], 0.0
    for i, row in enumerate(run.losses):
        mean += (row[2] - mean) * max(0.01, 1 / (i + 1))
        smooth.append(mean)
    left.semilogy(minutes, smooth)
    left.set(xlabel="minutes", ylabel="loss, running mean")
    for column, label in ((3, f"to {baseline}"), (4, "to noisy"), (6, "mean radiance to reference")):
        right.plot(
            [row[1] / 60 for row in run.validations], [row[column] for row in run.validations], ".-", label=label
        )
    right.set(xlabel="minutes", ylabel="validation: ratio", yscale="log")
    right.legend()
    publish(path, lambda temporary: figure.savefig(temporary, dpi=100))
    plt.close(figure)


def count(network: nn.Module) -> int:
    return sum(parameter.numel() for parameter in network.parameters())


def parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("network", choices=list(TASKS))
    parser.add_argument("--data", type=Path, required=True, help="with train/ and validation/")
    parser.add_argument("--out", type=Path, required=True)
    budget = parser.add_mutually_exclusive_group(required=True)
    budget.add_argument("--steps", type=int, default=0)
    budget.add_argument("--minutes", type=float, default=0.0)
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--crop", type=int, default=128, help="side of what is cut out of a view")
    parser.add_argument("--lr", type=float, default=1e-3)
    parser.add_argument("--weight-decay", type=float, default=1e-4)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--hold-out", metavar="SCENE")
    parser.add_argument("--at-most", type=int, metavar="VIEWS")
    parser.add_argument("--initial", type=Path, help="a finished run, whose weights this one starts from")
    parser.add_argument("--validation-views", type=int, default=40)
    parser.add_argument("--validate-minutes", type=float, default=5.0)
    parser.add_argument("--checkpoint-seconds", type=float, default=60.0)
    for name in ARCHITECTURE:
        parser.add_argument(f"--{name}", type=int, help="of the combiners, other than the published one")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    main()
