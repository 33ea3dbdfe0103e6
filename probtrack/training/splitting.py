"""Scenes of a data set in parts that have nothing in common."""

import math
from pathlib import Path

import torch

from probtrack.errors import InputError
from probtrack.simulation import read_manifest
from probtrack.training.seeds import seed_of


def split_by_scene(folder: str | Path, shares: tuple[float, ...], seed: int = 0) -> list[list[Path]]:
    """Return the scene folders of a data set in parts, drawn without regard to anything but whole scenes.

    The recordings of one scene at several signal-to-noise ratios are the same walk and the same words: they go to
    one part. A data set that grows is split anew.

    Args:
        folder: Of the data set.
        shares: Of the scenes that go to each part, at least 0, with sum 1; a part with a share gets a scene at least.
        seed: Of the draw.

    Raises:
        InputError: for shares that cannot be, or fewer scenes than parts.
    """
    if not all(math.isfinite(s) and s >= 0 for s in shares) or abs(sum(shares) - 1) > 1e-6:
        raise InputError(f"split must be shares of at least 0 with sum 1, got {', '.join(f'{s:g}' for s in shares)}")
    rows = read_manifest(folder)
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    if len(scenes) < sum(share > 0 for share in shares):
        raise InputError(f"{folder}: {len(scenes)} scenes are fewer than the parts of split that are not 0")
    order = torch.randperm(len(scenes), generator=torch.Generator().manual_seed(seed_of(seed))).tolist()
    parts: dict[str, int] = {}
    for part, count in enumerate(_counts(len(scenes), shares)):
        parts |= {scenes[i]: part for i in order[len(parts) : len(parts) + count]}
    return [[Path(folder) / r["folder"] for r in rows if parts[r["scene"]] == part] for part in range(len(shares))]


def _counts(total: int, shares: tuple[float, ...]) -> list[int]:
    """Return whole numbers next to `total` times each share, with sum `total`."""
    counts = [max(1, math.floor(total * share + 1e-9)) if share > 0 else 0 for share in shares]
    while sum(counts) != total:  # what is left over, or missing, goes where it is least wrong
        step = 1 if sum(counts) < total else -1
        over = [step * (count - total * share) for count, share in zip(counts, shares, strict=True)]
        able = [i for i, share in enumerate(shares) if share > 0 and counts[i] + step > 0]
        counts[min(able, key=lambda i: over[i])] += step
    return counts
