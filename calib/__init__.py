"""The mathematics: model, geometry, clocks, excitation, sums and estimators. It uses no files, threads or system clock.

The names below are what a notebook needs (docs/api.md shows each with an example). Each is imported when it is first
used, so that `import calib` alone loads neither numpy nor scipy.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from calib.adjustment.adjustment import adjust
    from calib.adjustment.norm_fit import norm_fit
    from calib.estimate.correction import corrected
    from calib.estimate.nuisances import Priors
    from calib.excitation.front_end import windows_of
    from calib.excitation.windows import rests_anywhere
    from calib.geometry import along, at_rest, beside, clamp, on_axis
    from calib.model import PARAMETERS, Calibration, Pose, Window
    from calib.paper.method3 import fit as fit_method3
    from calib.paper.sine_fit import four_parameter as four_parameter_sine
    from calib.paper.sine_fit import three_parameter as three_parameter_sine
    from calib.recorded.errors import InputError
    from calib.recorded.notebook import calibrate
    from calib.signal.instrument import Instrument
    from calib.signal.samples import Samples
    from calib.signal.stamps import clock_from_stamps

__version__ = "0.3.0"

__all__ = [
    "PARAMETERS",
    "Calibration",
    "InputError",
    "Instrument",
    "Pose",
    "Priors",
    "Samples",
    "Window",
    "adjust",
    "along",
    "at_rest",
    "beside",
    "calibrate",
    "clamp",
    "clock_from_stamps",
    "corrected",
    "fit_method3",
    "four_parameter_sine",
    "norm_fit",
    "on_axis",
    "rests_anywhere",
    "three_parameter_sine",
    "windows_of",
]

_PLACES = {
    "calib.adjustment.adjustment": ("adjust",),
    "calib.estimate.correction": ("corrected",),
    "calib.adjustment.norm_fit": ("norm_fit",),
    "calib.estimate.nuisances": ("Priors",),
    "calib.excitation.front_end": ("windows_of",),
    "calib.excitation.windows": ("rests_anywhere",),
    "calib.geometry": ("along", "at_rest", "beside", "clamp", "on_axis"),
    "calib.model": ("PARAMETERS", "Calibration", "Pose", "Window"),
    "calib.recorded.errors": ("InputError",),
    "calib.recorded.notebook": ("calibrate",),
    "calib.signal.instrument": ("Instrument",),
    "calib.signal.samples": ("Samples",),
    "calib.signal.stamps": ("clock_from_stamps",),
}
_PLACE = {name: (module, name) for module, names in _PLACES.items() for name in names} | {
    "fit_method3": ("calib.paper.method3", "fit"),
    "four_parameter_sine": ("calib.paper.sine_fit", "four_parameter"),
    "three_parameter_sine": ("calib.paper.sine_fit", "three_parameter"),
}


def __getattr__(name: str) -> Any:
    if name not in _PLACE:
        raise AttributeError(f"module 'calib' has no attribute {name!r}")
    module, attribute = _PLACE[name]
    value = getattr(import_module(module), attribute)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
