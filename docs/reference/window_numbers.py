"""The names in `numbers` of a result `window`, for docs/reference/messages.md."""

from __future__ import annotations

THRESHOLD = "_threshold"  # ends the name of a limit, which stands beside its statistic
NUMBERS = {
    "missing_samples": "samples of the sensor that lack in its part of the stretch",
    "late_samples": "samples of the sensor that came after their window was made",
    "restarts": "times that the sensor began to count anew",
    "reference_missing_samples, reference_late_samples, reference_restarts": "the same of the reference",
    "check_reference": "1: the window is beside the second reference",
    "position_chi2": "chi-squared of the mean output at the nearest stated position",
    "position_log_odds": "natural logarithm of the odds of this position to the next best",
    "found_gravity_mps2": "mean acceleration, where angles are found from gravity",
    "found_theta_deg, u_found_theta_deg, found_alpha_deg, u_found_alpha_deg": "angles found from gravity",
    "slipped_mps2": "by how much the mean changed without a turn",
    "points": "samples in the sums of the window",
    "independent_points": "how many of them are independent in the band of the motion; only where too few are",
    "left_out_pct": "share of the samples that are knocks",
    "dropped_points": "samples in segments that were left out whole, because they are full of knocks",
    "at_rest_pct": "share of the samples at rest; of a rest",
    "reference_rms_mps2": "motion of the reference in its band",
    "reference_noise_mps2": "noise of the reference in the same band",
    "coherence": "share of the sensor's power that the reference explains, in band",
    "drift_mps2, u_drift_mps2": "largest change of the sensor's mean within the window",
    "step_mps2, u_step_mps2": "step of the sensor's mean from one part of the window to the other",
    "nonlinearity_pct, u_nonlinearity_pct": "by how much the sensitivity differs where the motion is strongest",
    "motion_kurtosis": "3 for Gaussian motion, 1.5 for a sine",
    "stuck_axes": "outputs that have one value in the whole window",
    "clipped_points": "samples at the end of the sensor's range",
    "cycles": "how many cycles a slow motion makes in the window",
    "filled_samples, reference_filled_samples": "missing samples that were filled, in short holes",
    "reference_glitches": "samples of the reference that were left out as glitches",
    "hum_lines": "lines of the mains that were filtered out",
    "misplaced_samples": "samples left out, because they have another lag than the rest",
    "lag_applied_s": "the lag that was taken out of the sensor's times",
    "innovation_chi2": "chi-squared of the window against the state; of windows that are used or held",
    "change_main_pct, change_transverse_pct, change_offset": "largest change of a parameter from what an operator last "
    "accepted; of the offset in output unit",
    "rotation_deg": "common rotation of S from what an operator last accepted",
    "offset": "largest offset, in output unit; with `largest_offset`",
    "determined": "how many parameters are determined; before the first calibration",
}
