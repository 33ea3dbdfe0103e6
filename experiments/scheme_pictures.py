"""The table and the picture of `experiments.resampling_schemes`."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from probtrack.plotting import check_picture

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Row = dict[str, Any]
_COLOURS = (
    "#444444", "#999999", "#1764ab", "#6aa9dd", "#0b8a8f", "#d9572b", "#2e8b57", "#7b4aa0", "#b8860b", "#c2327b",
)  # fmt: skip


def markdown(rows: list[Row]) -> str:
    """Return one table for each model, number of frames and number of particles."""
    tables = []
    for case in dict.fromkeys((row["model"], row["frames"], row["particles"]) for row in rows):
        here = [row for row in rows if (row["model"], row["frames"], row["particles"]) == case]
        names = list(here[0]["error"])
        exact = here[0]["exact_std"]
        heads = [f"{n} (exact std {exact[n]:.3g})" if n in exact else n for n in names]
        lines = [
            f"**{case[0]}, T = {case[1]}, N = {case[2]}**: mean error ± standard error; bias on a sequence / chance",
            "",
            "| scheme | " + " | ".join(heads) + " | ms a frame | over naive |",
            "|---" * (len(names) + 3) + "|",
        ]
        for row in here:
            cells = [_cell(row["error"][name]) for name in names]
            ratio = row["ms_per_frame"] / here[0]["ms_per_frame"]
            lines.append(f"| {row['scheme']} | " + " | ".join(cells) + f" | {row['ms_per_frame']:.2g} | {ratio:.2g} |")
        tables.append("\n".join(lines))
    return "\n\n".join(tables) + "\n"


def _cell(error: dict[str, float]) -> str:
    seen = error["rms_bias"] > error["resolution"]
    bias = f"{error['rms_bias']:.2g}" if seen else f"< {error['resolution']:.2g}"
    return f"{error['bias']:.2g} ± {error['se']:.1g}; {bias} / {error['chance']:.2g}"


def draw(rows: list[Row], output: Path) -> None:
    """Draw errors of the first case, how they change with the numbers of particles and of frames, and the cost."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise ImportError("pictures need matplotlib: pip install 'probtrack[report]'") from None
    check_picture(output)
    first = rows[0]
    mine = [row for row in rows if row["model"] == first["model"]]
    here = [row for row in mine if (row["frames"], row["particles"]) == (first["frames"], first["particles"])]
    colours = {row["scheme"]: _COLOURS[k % len(_COLOURS)] for k, row in enumerate(here)}
    figure = Figure(figsize=(13, 8.2), layout="constrained")
    top, bottom = figure.subplots(2, 4, height_ratios=(1.1, 1))
    for axis, name in zip(top, first["error"], strict=True):
        _bars(axis, here, name, colours)
    top[0].set_yticks(range(len(here)), [row["scheme"] for row in here])
    for axis in top[1:]:
        axis.set_yticks(range(len(here)), [])
    gradient = next(iter(first["exact_std"]))
    by_particles = [row for row in mine if row["frames"] == first["frames"]]
    by_frames = [row for row in mine if row["particles"] == first["particles"]]
    _lines(bottom[0], by_particles, "particles", "rms_bias", gradient, colours)
    _lines(bottom[1], by_particles, "particles", "chance", gradient, colours)
    _lines(bottom[2], by_frames, "frames", "chance", gradient, colours)
    naive = here[0]["ms_per_frame"]
    bottom[3].barh(
        range(len(here)), [row["ms_per_frame"] / naive for row in here], color=[colours[r["scheme"]] for r in here]
    )
    bottom[3].set(xlabel="cost over naive", xscale="log", yticks=[], ylim=(len(here) - 0.5, -0.5))
    bottom[3].axvline(1, color="black", lw=0.8)
    legend = "dot: mean error, thick: bias, thin: all error, dashed: size of the exact gradient"
    title = f"{first['model']}: T = {first['frames']}, N = {first['particles']} above; {legend}"
    figure.suptitle(title, fontsize=11)
    figure.savefig(output, dpi=80)


def _bars(axis: "Axes", rows: list[Row], name: str, colours: dict[str, str]) -> None:
    """Draw around zero how large bias (thick) and all of the error (thin) are, and the mean error as a dot."""
    for place, row in enumerate(rows):
        error, colour = row["error"][name], colours[row["scheme"]]
        total = (error["rms_bias"] ** 2 + error["chance"] ** 2) ** 0.5
        axis.plot([-total, total], [place] * 2, color=colour, lw=1.5)
        thick = [-error["rms_bias"], error["rms_bias"]]
        axis.plot(thick, [place] * 2, color=colour, lw=7, alpha=0.5, solid_capstyle="butt")
        axis.errorbar(error["bias"], place, xerr=2 * error["se"], fmt="o", color=colour, ms=5, capsize=3)
    axis.axvline(0, color="black", lw=0.8)
    if name in rows[0]["exact_std"]:
        for sign in (-1, 1):
            axis.axvline(sign * rows[0]["exact_std"][name], color="black", ls=(0, (4, 2)), lw=1)
    title = f"error of {name}" if name == "log evidence" else f"error of ∂/∂{name}"
    axis.set(title=title, ylim=(len(rows) - 0.5, -0.5))
    axis.grid(axis="x", color="0.9")


def _lines(axis: "Axes", rows: list[Row], along: str, what: str, name: str, colours: dict[str, str]) -> None:
    """Draw one part of the error against the number of frames or particles; a bias that chance hides is left out."""
    for scheme, colour in colours.items():
        mine = sorted((row for row in rows if row["scheme"] == scheme), key=lambda row: row[along])
        errors = [(row[along], row["error"][name]) for row in mine]
        shown = [(x, error[what]) for x, error in errors if what == "chance" or error["rms_bias"] > error["resolution"]]
        if shown:
            axis.plot(*zip(*shown, strict=True), "o-", color=colour, ms=4, lw=1.4)
    exact = sorted((row[along], row["exact_std"][name]) for row in rows)
    axis.plot(*zip(*exact, strict=True), color="black", ls=(0, (4, 2)), lw=1)
    label = {"rms_bias": "bias on a sequence", "chance": "chance"}[what]
    axis.set(xscale="log", yscale="log", xlabel=f"{along} {'N' if along == 'particles' else 'T'}")
    values = sorted({row[along] for row in rows})
    axis.set_xticks(values, map(str, values))
    axis.set_xticks([], minor=True)
    axis.set_title(f"{label} of ∂/∂{name}", fontsize=10)
    axis.grid(color="0.9")
