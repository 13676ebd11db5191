"""What is wrong with a clamp, and what the person can do, in plain sentences."""

from __future__ import annotations

from typing import Any

import numpy as np

from calib.visit.clamping import Clamping

AXES = "xyz"
ALONG = 0.9  # share of a rotation about one axis by which it is called one about that axis


def findings(clamp: Clamping, name: str) -> dict[str, str]:
    """What is wrong with the clamp beside the sensor of this name: {kind: sentence}; empty if nothing is.

    Kinds: "loose", "turned", "little motion".
    """
    found = {}
    if clamp.resonant:
        found["loose"] = (
            f"the clamp is loose or soft: towards {clamp.high_hz:.3g} Hz {name} shows {100.0 * clamp.rise:.2g} % less "
            "of the reference's motion than at low frequencies, as beside a mass on a spring; tighten the clamp, and "
            "shorten its bracket"
        )
    elif clamp.rattles:
        found["loose"] = (
            f"the clamp is loose: {100.0 * clamp.rattle:.2g} % of the motion is not common to the reference and "
            f"{name}, and it grows with the motion; tighten the clamp, and look for a cable that strikes"
        )
    if clamp.turned:
        by, u = clamp.turned_deg, float(clamp.u_turned_deg.max())
        found["turned"] = (
            f"the reference is turned by {_turn(by)} (u {u:.2g} deg) from the stated rotation; turn it back, or "
            "state the rotation as it is"
        )
    if clamp.drowned:
        found["little motion"] = (
            f"too little motion: {1e3 * float(clamp.moved_mps2.max()):.2g} mm/s2 rms, and the noise is "
            f"{1e3 * clamp.noise_mps2:.2g} mm/s2; wait for wind or traffic, or walk or jump near {name}"
        )
    return found


def _turn(by_deg: np.ndarray[Any, Any]) -> str:
    whole = float(np.linalg.norm(by_deg))
    k = int(np.argmax(np.abs(by_deg)))
    if abs(by_deg[k]) >= ALONG * whole:
        return f"{by_deg[k]:+.2g} deg about its {AXES[k]} axis"
    parts = ", ".join(f"{axis} {value:+.2g}" for axis, value in zip(AXES, by_deg, strict=True))
    return f"{whole:.2g} deg (about its axes, in deg: {parts})"


def as_object(clamp: Clamping, found: dict[str, str]) -> dict[str, Any]:
    """The members of the JSON object."""
    return {
        "findings": [{"kind": kind, "told": told} for kind, told in found.items()],
        "turned_deg": clamp.turned_deg.tolist(),
        "u_turned_deg": clamp.u_turned_deg.tolist(),
        "coherence": clamp.coherence,
        "rise": clamp.rise,
        "rattle": clamp.rattle,
        "moved_mps2": clamp.moved_mps2.tolist(),
        "noise_mps2": clamp.noise_mps2,
        "bands": [
            {"low_hz": b.low_hz, "high_hz": b.high_hz, "coherence": b.coherence, "gain": b.gain, "u_gain": b.u_gain}
            for b in clamp.bands
        ],
    }
