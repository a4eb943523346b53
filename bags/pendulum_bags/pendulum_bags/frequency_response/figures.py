"""Bode and Nyquist plots of both plants and the model, the gap per frequency, and the set of certified gains."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from pendulum_bags.arrays import Array, Complex
from pendulum_bags.figures.figure import Figure, Mark, Panel, Trace
from pendulum_bags.frequency_response.compare import SMALLEST, Difference, continuous
from pendulum_bags.frequency_response.designs import DesignResult
from pendulum_bags.frequency_response.result import Analysis
from pendulum_lqr.linear.design import DesignError, output_lqr
from pendulum_lqr.linear.model import LinearModel
from pendulum_lqr.responses.certificate import Certifier
from pendulum_lqr.responses.gap_metric import JointScaling, SignalScaling
from pendulum_lqr.responses.measured_response import MeasuredResponse
from pendulum_lqr.responses.sampled_response import model_response

__all__ = ["certified_gains_figure", "certified_weights_figure", "gap_figure", "response_figures"]

SECTION = "Frequency response"
_NAMES = {"sim": "simulation", "hw": "hardware"}
_GRID = 36


def _name(measured: MeasuredResponse) -> str:
    return _NAMES.get(measured.label, measured.label)


def response_figures(analysis: Analysis) -> list[Figure]:
    """Return the figures of one or two measured plants."""
    certifier, designs = analysis.certifier, analysis.designs
    figures = [bode(analysis), _quality(analysis.responses)]
    if certifier is not None:
        figures.append(gap_figure(certifier, analysis.difference, designs))
        figures += [_nyquist(certifier, design) for design in designs[:1] if design.K is not None]
        if not analysis.responses[0].joints:
            figures += [certified_weights_figure(certifier, analysis.model), certified_gains_figure(certifier, designs)]
    return figures


def _channels(measured: MeasuredResponse, scaling: SignalScaling) -> list[tuple[int, str, Callable[[Complex], Array]]]:
    if not isinstance(scaling, JointScaling):
        return [
            (0, "angle per torque\n[rad/(N m)]", np.abs),
            (0, "its phase [deg]", _phase),
            (1, "velocity per torque\n[rad/s/(N m)]", np.abs),
        ]
    effort = f"({scaling.effort_unit})" if " " in scaling.effort_unit else scaling.effort_unit
    sizes: list[tuple[int, str, Callable[[Complex], Array]]] = [
        (i, f"{name} per effort\n[{scaling.units[i]}/{effort}]", np.abs) for i, name in enumerate(measured.joints)
    ]
    return [*sizes, (measured.driven, f"phase of {measured.joints[measured.driven]}\n[deg]", _phase)]


def bode(analysis: Analysis) -> Figure:
    """Draw the continuous plants: hold and aliasing are removed, so that rates may differ."""
    responses, model, difference = analysis.responses, analysis.model, analysis.difference
    channels = _channels(responses[0], analysis.scaling)
    grid = np.geomspace(responses[0].frequency[0], max(r.frequency[-1] for r in responses), 400)
    line = model_response(model, grid)
    rows: list[list[Trace]] = [[] for _ in channels]
    for measured in responses:
        role, name = ("sim" if measured.label == "sim" else "hw"), _name(measured)
        free = continuous(measured, model)
        share = measured.radius() / np.abs(measured.response)
        for row, (channel, _, drawn) in zip(rows, channels, strict=True):
            values = drawn(free[channel])
            if drawn is _phase:
                room = np.degrees(np.arcsin(np.minimum(share[channel], 1.0)))
            else:
                room = values * np.minimum(share[channel], 0.99)
            low, high = values - room, values + room
            row.append(Trace(measured.frequency, 0.5 * (low + high), f"{name}, 95 %", role, "band", low, high))
            row.append(Trace(measured.frequency, values, name, role, "points"))
    for row, (channel, _, drawn) in zip(rows, channels, strict=True):
        row.append(Trace(grid, drawn(line[channel]), "model", "model"))
    panels = [
        Panel("frequency [Hz]", label, row, x_log=True, y_log=drawn is not _phase)
        for row, (_, label, drawn) in zip(rows, channels, strict=True)
    ]
    lowest, highest = responses[0].frequency[0], responses[-1].frequency[-1]
    count = " and ".join(dict.fromkeys(str(r.frequency.size) for r in responses))
    sentence = (
        f"Measured at {count} frequencies from {lowest:.2g} to "
        f"{highest:.3g} Hz; bands hold the true response with 95 % probability, all frequencies together. Hold and "
        "folding of sampling were taken out by the model's ratio."
    )
    if difference is not None:
        sentence += f" {difference_sentence(difference)}"
    return Figure("bode", "Bode plot of the plants", sentence, panels, section=SECTION, panel_height=180)


def difference_sentence(difference: Difference) -> str:
    """Return where two plants differ, as a sentence."""
    if not difference.found:
        return f"No difference above {100.0 * SMALLEST:g} % was found between simulation and hardware."
    n, total = difference.lines_that_differ, difference.frequency.size
    delay, gain = difference.delay, difference.gain
    return (
        f"They differ by more than {100.0 * SMALLEST:g} % at {n} of {total} frequencies; the gap is largest at "
        f"{difference.gap_at:.2g} Hz. Over all, the hardware responds {abs(delay.value) * 1e3:.2f} ms "
        f"{'later' if delay.value >= 0.0 else 'earlier'} and {gain.value:.3g} times as strongly."
    )


def _phase(values: Complex) -> Array:
    phase = np.degrees(np.unwrap(np.angle(values)))
    # Torque first lifts an upright pendulum away from it: the phase of its angle starts near -180 degrees.
    return np.asarray(phase - 360.0 * round((phase[0] + 120.0) / 360.0), dtype=np.float64)


def _quality(responses: Sequence[MeasuredResponse]) -> Figure:
    coherence, precision = [], []
    for measured in responses:
        role, name = ("sim" if measured.label == "sim" else "hw"), _name(measured)
        shown = measured.driven
        coherence.append(Trace(measured.frequency, measured.coherence[shown], name, role))
        share = 100.0 * measured.radius(joint=False)[shown] / np.abs(measured.response[shown])
        precision.append(Trace(measured.frequency, np.maximum(share, 1e-6), name, role))
    joints = responses[0].joints
    what = joints[responses[0].driven] if joints else "the angle"
    panels = [
        Panel("frequency [Hz]", f"coherence of {what}\nwith the excitation [-]", coherence, x_log=True),
        Panel("frequency [Hz]", "95 % radius\n[% of the response]", precision, x_log=True, y_log=True),
    ]
    weakest = min(float(r.coherence[r.driven].min()) for r in responses)
    sentence = f"The lowest coherence is {weakest:.3f}: the share of the power of {what} that the excitation explains."
    return Figure("response_quality", "How well it was measured", sentence, panels, section=SECTION, panel_height=150)


def gap_figure(certifier: Certifier, difference: Difference | None, designs: Sequence[DesignResult]) -> Figure:
    """Draw the gap per frequency with the margins of designs."""
    profile = certifier.profile
    shown = profile.frequency > 0.0
    x = profile.frequency[shown]
    traces = [
        Trace(x, profile.upper[shown], "model and hardware, upper 95 % limit", "hw"),
        Trace(x, profile.gap[shown], "model and hardware", "model"),
    ]
    if difference is not None:
        traces.append(Trace(difference.frequency, difference.gap_high, "simulation and hardware, upper limit", "sim"))
    marks = [
        Mark(design.certificate.margin, "y", f"{design.name}: b = {design.certificate.margin:.2f}")
        for design in designs
        if design.certificate.stable_on_model and not design.unknown
    ]
    # Overlapping labels are unreadable: the smallest and the largest margin suffice.
    marks = [min(marks, key=lambda m: m.value), max(marks, key=lambda m: m.value)] if len(marks) > 2 else marks
    passing = sum(design.certificate.by_gap and not design.unknown for design in designs)
    sentence = (
        f"The nu-gap between model and hardware is {profile.value:.3f}, at most {profile.value_upper:.3f} with 95 % "
        f"confidence, largest at {profile.at:.2g} Hz: {passing} of {len(designs)} designs have a larger margin "
        f"b(P, K). {profile.scaling.sentence()}"
    )
    panel = Panel("frequency [Hz]", "gap [-]", traces, marks, x_log=True, y_range=(0.0, _top(traces, marks)))
    return Figure("gap", "Gap per frequency", sentence, [panel], section=SECTION, panel_height=260)


def _top(traces: Sequence[Trace], marks: Sequence[Mark]) -> float:
    highest = max([float(np.max(trace.y)) for trace in traces] + [mark.value for mark in marks])
    return min(1.05, 1.15 * highest + 0.02)


def _nyquist(certifier: Certifier, design: DesignResult) -> Figure:
    assert design.K is not None
    machine = certifier.machine
    K = np.asarray(design.K)[:, None]
    loop, radius = np.sum(K * machine.response, axis=0), np.sum(np.abs(K) * machine.radius, axis=0)
    on_model = np.sum(K * model_response(certifier.plant, machine.frequency, machine.period), axis=0)
    near = np.abs(loop) < 4.0
    angle = np.linspace(0.0, 2.0 * np.pi, 24)
    discs_x, discs_y = [], []
    for centre, r in zip(loop[near][::6], radius[near][::6], strict=True):
        discs_x += [*(centre.real + r * np.cos(angle)), math.nan]
        discs_y += [*(centre.imag + r * np.sin(angle)), math.nan]
    traces = [
        Trace(on_model[np.abs(on_model) < 4.0].real, on_model[np.abs(on_model) < 4.0].imag, "model", "model"),
        Trace(loop[near].real, loop[near].imag, "hardware", "hw"),
        Trace(np.array(discs_x), np.array(discs_y), "95 % discs", "hw alone"),
        Trace(np.array([-1.0]), np.array([0.0]), "-1", "unstable", "points"),
    ]
    certificate = design.certificate
    sentence = (
        f"Loop of {design.name}: on the hardware it keeps {certificate.worst_modulus:.2f} from -1 at least, with 95 % "
        "confidence."
    )
    panel = Panel("real part [-]", "imaginary part [-]", traces, square=True)
    return Figure("nyquist", "Nyquist plot of the loop", sentence, [panel], section=SECTION, panel_height=380)


def certified_weights_figure(certifier: Certifier, model: LinearModel) -> Figure:
    """Draw which LQR weights give certified gains: only q11/r and q22/r matter."""
    angle, speed = np.geomspace(1.0, 1e5, _GRID), np.geomspace(1e-3, 1e3, _GRID)
    points: list[tuple[float, float, int]] = []
    for a in angle:
        for b in speed:
            try:
                gain = output_lqr(model, (a, b), 1.0)
            except DesignError:
                continue
            points.append((a, b, _class(certifier, np.asarray(gain.K)[:2])))
    return _set_figure(
        "certified_weights",
        "LQR weights that carry over",
        points,
        "q11 / r [(N m)²/rad²]",
        "q22 / r [(N m)² s²/rad²]",
        "weights",
    )


def certified_gains_figure(certifier: Certifier, designs: Sequence[DesignResult]) -> Figure:
    """Draw which gains of u = -kp theta - kd theta_dot are certified, and where the designs are."""
    A, B = certifier.plant.A, certifier.plant.B
    is_rigid = A.shape[0] == 2
    stiffness = max(float(abs(A[1, 0] / B[1, 0])), 1e-3) if is_rigid else 1.0
    known = [design.K for design in designs if design.K is not None]
    low = 0.5 * min([stiffness, *(K[0] for K in known)])
    high = 20.0 * max([stiffness, *(K[0] for K in known)])
    damping = [max(K[1], 1e-3) for K in known] or [1.0]
    kp, kd = np.geomspace(low, high, _GRID), np.geomspace(0.02 * min(damping), 50.0 * max(damping), _GRID)
    points = [(a, b, _class(certifier, np.array([a, b]))) for a in kp for b in kd]
    more = [
        Trace(np.array([K[0]]), np.array([max(K[1], kd[0])]), "" if i else "designs", "difference", "points")
        for i, K in enumerate(known)
    ]
    return _set_figure(
        "certified_gains", "Gains that carry over", points, "kp [N m/rad]", "kd [N m s/rad]", "gains", more
    )


def _class(certifier: Certifier, K: Array) -> int:
    found = certifier.gain(K)
    return 0 if found.certified else 1 if found.stable_on_model else 2


def _set_figure(
    name: str,
    title: str,
    points: Sequence[tuple[float, float, int]],
    x_label: str,
    y_label: str,
    what: str,
    more: Sequence[Trace] = (),
) -> Figure:
    kinds = (
        ("certified for this machine", "certified"),
        ("stabilises the model, not certified", "not certified"),
        ("does not stabilise the model", "not stabilising"),
    )
    values = np.array(points)
    traces = [
        Trace(values[values[:, 2] == i, 0], values[values[:, 2] == i, 1], label, role, "points")
        for i, (label, role) in enumerate(kinds)
        if np.any(values[:, 2] == i)
    ]
    stable = int(np.sum(values[:, 2] < 2))
    sentence = (
        f"{int(np.sum(values[:, 2] == 0))} of the {stable} {what} on this map that stabilise the model are certified "
        "for the hardware: they stabilise every linear plant within the confidence region. Saturation and friction at "
        "rest are outside of it."
    )
    panel = Panel(x_label, y_label, [*traces, *more], x_log=True, y_log=True)
    return Figure(name, title, sentence, [panel], section=SECTION, panel_height=360)
