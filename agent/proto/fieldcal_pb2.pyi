from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Event(_message.Message):
    __slots__ = ("event_sequence", "run_start", "device_change", "gap", "tick", "command", "pruned")
    class RunStart(_message.Message):
        __slots__ = ("run_id", "site", "gateway", "boot_id", "t_monotonic_ns", "t_utc_ns", "config_json", "versions", "fingerprint", "snapshot", "file_sequence", "continuation", "engine", "engine_sha256")
        class VersionsEntry(_message.Message):
            __slots__ = ("key", "value")
            KEY_FIELD_NUMBER: _ClassVar[int]
            VALUE_FIELD_NUMBER: _ClassVar[int]
            key: str
            value: str
            def __init__(self, key: _Optional[str] = ..., value: _Optional[str] = ...) -> None: ...
        class FingerprintEntry(_message.Message):
            __slots__ = ("key", "value")
            KEY_FIELD_NUMBER: _ClassVar[int]
            VALUE_FIELD_NUMBER: _ClassVar[int]
            key: str
            value: str
            def __init__(self, key: _Optional[str] = ..., value: _Optional[str] = ...) -> None: ...
        RUN_ID_FIELD_NUMBER: _ClassVar[int]
        SITE_FIELD_NUMBER: _ClassVar[int]
        GATEWAY_FIELD_NUMBER: _ClassVar[int]
        BOOT_ID_FIELD_NUMBER: _ClassVar[int]
        T_MONOTONIC_NS_FIELD_NUMBER: _ClassVar[int]
        T_UTC_NS_FIELD_NUMBER: _ClassVar[int]
        CONFIG_JSON_FIELD_NUMBER: _ClassVar[int]
        VERSIONS_FIELD_NUMBER: _ClassVar[int]
        FINGERPRINT_FIELD_NUMBER: _ClassVar[int]
        SNAPSHOT_FIELD_NUMBER: _ClassVar[int]
        FILE_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
        CONTINUATION_FIELD_NUMBER: _ClassVar[int]
        ENGINE_FIELD_NUMBER: _ClassVar[int]
        ENGINE_SHA256_FIELD_NUMBER: _ClassVar[int]
        run_id: str
        site: str
        gateway: str
        boot_id: str
        t_monotonic_ns: int
        t_utc_ns: int
        config_json: str
        versions: _containers.ScalarMap[str, str]
        fingerprint: _containers.ScalarMap[str, str]
        snapshot: bytes
        file_sequence: int
        continuation: bool
        engine: str
        engine_sha256: str
        def __init__(self, run_id: _Optional[str] = ..., site: _Optional[str] = ..., gateway: _Optional[str] = ..., boot_id: _Optional[str] = ..., t_monotonic_ns: _Optional[int] = ..., t_utc_ns: _Optional[int] = ..., config_json: _Optional[str] = ..., versions: _Optional[_Mapping[str, str]] = ..., fingerprint: _Optional[_Mapping[str, str]] = ..., snapshot: _Optional[bytes] = ..., file_sequence: _Optional[int] = ..., continuation: _Optional[bool] = ..., engine: _Optional[str] = ..., engine_sha256: _Optional[str] = ...) -> None: ...
    class DeviceChange(_message.Message):
        __slots__ = ("device", "state", "t_monotonic_ns", "t_utc_ns", "message", "info_json", "attempt")
        DEVICE_FIELD_NUMBER: _ClassVar[int]
        STATE_FIELD_NUMBER: _ClassVar[int]
        T_MONOTONIC_NS_FIELD_NUMBER: _ClassVar[int]
        T_UTC_NS_FIELD_NUMBER: _ClassVar[int]
        MESSAGE_FIELD_NUMBER: _ClassVar[int]
        INFO_JSON_FIELD_NUMBER: _ClassVar[int]
        ATTEMPT_FIELD_NUMBER: _ClassVar[int]
        device: str
        state: str
        t_monotonic_ns: int
        t_utc_ns: int
        message: str
        info_json: str
        attempt: int
        def __init__(self, device: _Optional[str] = ..., state: _Optional[str] = ..., t_monotonic_ns: _Optional[int] = ..., t_utc_ns: _Optional[int] = ..., message: _Optional[str] = ..., info_json: _Optional[str] = ..., attempt: _Optional[int] = ...) -> None: ...
    class Gap(_message.Message):
        __slots__ = ("device", "t_monotonic_ns", "dropped", "unit", "reason")
        DEVICE_FIELD_NUMBER: _ClassVar[int]
        T_MONOTONIC_NS_FIELD_NUMBER: _ClassVar[int]
        DROPPED_FIELD_NUMBER: _ClassVar[int]
        UNIT_FIELD_NUMBER: _ClassVar[int]
        REASON_FIELD_NUMBER: _ClassVar[int]
        device: str
        t_monotonic_ns: int
        dropped: int
        unit: str
        reason: str
        def __init__(self, device: _Optional[str] = ..., t_monotonic_ns: _Optional[int] = ..., dropped: _Optional[int] = ..., unit: _Optional[str] = ..., reason: _Optional[str] = ...) -> None: ...
    class Tick(_message.Message):
        __slots__ = ("t_monotonic_ns", "t_utc_ns")
        T_MONOTONIC_NS_FIELD_NUMBER: _ClassVar[int]
        T_UTC_NS_FIELD_NUMBER: _ClassVar[int]
        t_monotonic_ns: int
        t_utc_ns: int
        def __init__(self, t_monotonic_ns: _Optional[int] = ..., t_utc_ns: _Optional[int] = ...) -> None: ...
    class Command(_message.Message):
        __slots__ = ("sensor", "verb", "t_monotonic_ns", "t_utc_ns", "arguments_json", "calibration_json", "key_id", "counter", "refused")
        SENSOR_FIELD_NUMBER: _ClassVar[int]
        VERB_FIELD_NUMBER: _ClassVar[int]
        T_MONOTONIC_NS_FIELD_NUMBER: _ClassVar[int]
        T_UTC_NS_FIELD_NUMBER: _ClassVar[int]
        ARGUMENTS_JSON_FIELD_NUMBER: _ClassVar[int]
        CALIBRATION_JSON_FIELD_NUMBER: _ClassVar[int]
        KEY_ID_FIELD_NUMBER: _ClassVar[int]
        COUNTER_FIELD_NUMBER: _ClassVar[int]
        REFUSED_FIELD_NUMBER: _ClassVar[int]
        sensor: str
        verb: str
        t_monotonic_ns: int
        t_utc_ns: int
        arguments_json: str
        calibration_json: str
        key_id: str
        counter: int
        refused: str
        def __init__(self, sensor: _Optional[str] = ..., verb: _Optional[str] = ..., t_monotonic_ns: _Optional[int] = ..., t_utc_ns: _Optional[int] = ..., arguments_json: _Optional[str] = ..., calibration_json: _Optional[str] = ..., key_id: _Optional[str] = ..., counter: _Optional[int] = ..., refused: _Optional[str] = ...) -> None: ...
    class Pruned(_message.Message):
        __slots__ = ("t_monotonic_ns", "t_utc_ns", "first_file", "last_file", "last_sha256", "bytes", "epoch", "previous_sha256")
        T_MONOTONIC_NS_FIELD_NUMBER: _ClassVar[int]
        T_UTC_NS_FIELD_NUMBER: _ClassVar[int]
        FIRST_FILE_FIELD_NUMBER: _ClassVar[int]
        LAST_FILE_FIELD_NUMBER: _ClassVar[int]
        LAST_SHA256_FIELD_NUMBER: _ClassVar[int]
        BYTES_FIELD_NUMBER: _ClassVar[int]
        EPOCH_FIELD_NUMBER: _ClassVar[int]
        PREVIOUS_SHA256_FIELD_NUMBER: _ClassVar[int]
        t_monotonic_ns: int
        t_utc_ns: int
        first_file: int
        last_file: int
        last_sha256: str
        bytes: int
        epoch: str
        previous_sha256: str
        def __init__(self, t_monotonic_ns: _Optional[int] = ..., t_utc_ns: _Optional[int] = ..., first_file: _Optional[int] = ..., last_file: _Optional[int] = ..., last_sha256: _Optional[str] = ..., bytes: _Optional[int] = ..., epoch: _Optional[str] = ..., previous_sha256: _Optional[str] = ...) -> None: ...
    EVENT_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    RUN_START_FIELD_NUMBER: _ClassVar[int]
    DEVICE_CHANGE_FIELD_NUMBER: _ClassVar[int]
    GAP_FIELD_NUMBER: _ClassVar[int]
    TICK_FIELD_NUMBER: _ClassVar[int]
    COMMAND_FIELD_NUMBER: _ClassVar[int]
    PRUNED_FIELD_NUMBER: _ClassVar[int]
    event_sequence: int
    run_start: Event.RunStart
    device_change: Event.DeviceChange
    gap: Event.Gap
    tick: Event.Tick
    command: Event.Command
    pruned: Event.Pruned
    def __init__(self, event_sequence: _Optional[int] = ..., run_start: _Optional[_Union[Event.RunStart, _Mapping]] = ..., device_change: _Optional[_Union[Event.DeviceChange, _Mapping]] = ..., gap: _Optional[_Union[Event.Gap, _Mapping]] = ..., tick: _Optional[_Union[Event.Tick, _Mapping]] = ..., command: _Optional[_Union[Event.Command, _Mapping]] = ..., pruned: _Optional[_Union[Event.Pruned, _Mapping]] = ...) -> None: ...

class RawBlock(_message.Message):
    __slots__ = ("event_sequence", "device", "boot_id", "t_utc_ns", "first_index", "nominal_rate_hz", "flags", "temperature_raw", "temperature_degc", "axes", "decimal", "burst_t_monotonic_ns", "burst_count", "x_counts", "y_counts", "z_counts", "x", "y", "z", "first_burst_t_monotonic_ns", "burst_sizes", "order", "first_values", "differences", "decimal_places", "negative_zeros", "burst_intervals_ns")
    EVENT_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    DEVICE_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    T_UTC_NS_FIELD_NUMBER: _ClassVar[int]
    FIRST_INDEX_FIELD_NUMBER: _ClassVar[int]
    NOMINAL_RATE_HZ_FIELD_NUMBER: _ClassVar[int]
    FLAGS_FIELD_NUMBER: _ClassVar[int]
    TEMPERATURE_RAW_FIELD_NUMBER: _ClassVar[int]
    TEMPERATURE_DEGC_FIELD_NUMBER: _ClassVar[int]
    AXES_FIELD_NUMBER: _ClassVar[int]
    DECIMAL_FIELD_NUMBER: _ClassVar[int]
    BURST_T_MONOTONIC_NS_FIELD_NUMBER: _ClassVar[int]
    BURST_COUNT_FIELD_NUMBER: _ClassVar[int]
    X_COUNTS_FIELD_NUMBER: _ClassVar[int]
    Y_COUNTS_FIELD_NUMBER: _ClassVar[int]
    Z_COUNTS_FIELD_NUMBER: _ClassVar[int]
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    Z_FIELD_NUMBER: _ClassVar[int]
    FIRST_BURST_T_MONOTONIC_NS_FIELD_NUMBER: _ClassVar[int]
    BURST_SIZES_FIELD_NUMBER: _ClassVar[int]
    ORDER_FIELD_NUMBER: _ClassVar[int]
    FIRST_VALUES_FIELD_NUMBER: _ClassVar[int]
    DIFFERENCES_FIELD_NUMBER: _ClassVar[int]
    DECIMAL_PLACES_FIELD_NUMBER: _ClassVar[int]
    NEGATIVE_ZEROS_FIELD_NUMBER: _ClassVar[int]
    BURST_INTERVALS_NS_FIELD_NUMBER: _ClassVar[int]
    event_sequence: int
    device: str
    boot_id: str
    t_utc_ns: int
    first_index: int
    nominal_rate_hz: float
    flags: int
    temperature_raw: int
    temperature_degc: float
    axes: int
    decimal: bool
    burst_t_monotonic_ns: _containers.RepeatedScalarFieldContainer[int]
    burst_count: _containers.RepeatedScalarFieldContainer[int]
    x_counts: _containers.RepeatedScalarFieldContainer[int]
    y_counts: _containers.RepeatedScalarFieldContainer[int]
    z_counts: _containers.RepeatedScalarFieldContainer[int]
    x: _containers.RepeatedScalarFieldContainer[float]
    y: _containers.RepeatedScalarFieldContainer[float]
    z: _containers.RepeatedScalarFieldContainer[float]
    first_burst_t_monotonic_ns: int
    burst_sizes: bytes
    order: int
    first_values: _containers.RepeatedScalarFieldContainer[int]
    differences: bytes
    decimal_places: int
    negative_zeros: _containers.RepeatedScalarFieldContainer[int]
    burst_intervals_ns: bytes
    def __init__(self, event_sequence: _Optional[int] = ..., device: _Optional[str] = ..., boot_id: _Optional[str] = ..., t_utc_ns: _Optional[int] = ..., first_index: _Optional[int] = ..., nominal_rate_hz: _Optional[float] = ..., flags: _Optional[int] = ..., temperature_raw: _Optional[int] = ..., temperature_degc: _Optional[float] = ..., axes: _Optional[int] = ..., decimal: _Optional[bool] = ..., burst_t_monotonic_ns: _Optional[_Iterable[int]] = ..., burst_count: _Optional[_Iterable[int]] = ..., x_counts: _Optional[_Iterable[int]] = ..., y_counts: _Optional[_Iterable[int]] = ..., z_counts: _Optional[_Iterable[int]] = ..., x: _Optional[_Iterable[float]] = ..., y: _Optional[_Iterable[float]] = ..., z: _Optional[_Iterable[float]] = ..., first_burst_t_monotonic_ns: _Optional[int] = ..., burst_sizes: _Optional[bytes] = ..., order: _Optional[int] = ..., first_values: _Optional[_Iterable[int]] = ..., differences: _Optional[bytes] = ..., decimal_places: _Optional[int] = ..., negative_zeros: _Optional[_Iterable[int]] = ..., burst_intervals_ns: _Optional[bytes] = ...) -> None: ...

class RawBlockBytes(_message.Message):
    __slots__ = ("event_sequence", "device", "boot_id", "t_utc_ns", "first_index", "nominal_rate_hz", "flags", "temperature_raw", "temperature_degc", "axes", "decimal", "burst_t_monotonic_ns", "burst_count", "x_counts", "y_counts", "z_counts", "x", "y", "z", "first_burst_t_monotonic_ns", "burst_sizes", "order", "first_values", "differences", "decimal_places", "negative_zeros", "burst_intervals_ns")
    EVENT_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    DEVICE_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    T_UTC_NS_FIELD_NUMBER: _ClassVar[int]
    FIRST_INDEX_FIELD_NUMBER: _ClassVar[int]
    NOMINAL_RATE_HZ_FIELD_NUMBER: _ClassVar[int]
    FLAGS_FIELD_NUMBER: _ClassVar[int]
    TEMPERATURE_RAW_FIELD_NUMBER: _ClassVar[int]
    TEMPERATURE_DEGC_FIELD_NUMBER: _ClassVar[int]
    AXES_FIELD_NUMBER: _ClassVar[int]
    DECIMAL_FIELD_NUMBER: _ClassVar[int]
    BURST_T_MONOTONIC_NS_FIELD_NUMBER: _ClassVar[int]
    BURST_COUNT_FIELD_NUMBER: _ClassVar[int]
    X_COUNTS_FIELD_NUMBER: _ClassVar[int]
    Y_COUNTS_FIELD_NUMBER: _ClassVar[int]
    Z_COUNTS_FIELD_NUMBER: _ClassVar[int]
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    Z_FIELD_NUMBER: _ClassVar[int]
    FIRST_BURST_T_MONOTONIC_NS_FIELD_NUMBER: _ClassVar[int]
    BURST_SIZES_FIELD_NUMBER: _ClassVar[int]
    ORDER_FIELD_NUMBER: _ClassVar[int]
    FIRST_VALUES_FIELD_NUMBER: _ClassVar[int]
    DIFFERENCES_FIELD_NUMBER: _ClassVar[int]
    DECIMAL_PLACES_FIELD_NUMBER: _ClassVar[int]
    NEGATIVE_ZEROS_FIELD_NUMBER: _ClassVar[int]
    BURST_INTERVALS_NS_FIELD_NUMBER: _ClassVar[int]
    event_sequence: int
    device: str
    boot_id: str
    t_utc_ns: int
    first_index: int
    nominal_rate_hz: float
    flags: int
    temperature_raw: int
    temperature_degc: float
    axes: int
    decimal: bool
    burst_t_monotonic_ns: bytes
    burst_count: bytes
    x_counts: bytes
    y_counts: bytes
    z_counts: bytes
    x: bytes
    y: bytes
    z: bytes
    first_burst_t_monotonic_ns: int
    burst_sizes: bytes
    order: int
    first_values: bytes
    differences: bytes
    decimal_places: int
    negative_zeros: bytes
    burst_intervals_ns: bytes
    def __init__(self, event_sequence: _Optional[int] = ..., device: _Optional[str] = ..., boot_id: _Optional[str] = ..., t_utc_ns: _Optional[int] = ..., first_index: _Optional[int] = ..., nominal_rate_hz: _Optional[float] = ..., flags: _Optional[int] = ..., temperature_raw: _Optional[int] = ..., temperature_degc: _Optional[float] = ..., axes: _Optional[int] = ..., decimal: _Optional[bool] = ..., burst_t_monotonic_ns: _Optional[bytes] = ..., burst_count: _Optional[bytes] = ..., x_counts: _Optional[bytes] = ..., y_counts: _Optional[bytes] = ..., z_counts: _Optional[bytes] = ..., x: _Optional[bytes] = ..., y: _Optional[bytes] = ..., z: _Optional[bytes] = ..., first_burst_t_monotonic_ns: _Optional[int] = ..., burst_sizes: _Optional[bytes] = ..., order: _Optional[int] = ..., first_values: _Optional[bytes] = ..., differences: _Optional[bytes] = ..., decimal_places: _Optional[int] = ..., negative_zeros: _Optional[bytes] = ..., burst_intervals_ns: _Optional[bytes] = ...) -> None: ...

class Window(_message.Message):
    __slots__ = ("event_sequence", "run_id", "sequence", "sensor", "t_utc_ns", "start_s", "stop_s", "position", "used", "reason", "points", "left_out", "numbers", "fault", "engine", "signature")
    class NumbersEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: float
        def __init__(self, key: _Optional[str] = ..., value: _Optional[float] = ...) -> None: ...
    EVENT_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    RUN_ID_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    SENSOR_FIELD_NUMBER: _ClassVar[int]
    T_UTC_NS_FIELD_NUMBER: _ClassVar[int]
    START_S_FIELD_NUMBER: _ClassVar[int]
    STOP_S_FIELD_NUMBER: _ClassVar[int]
    POSITION_FIELD_NUMBER: _ClassVar[int]
    USED_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    POINTS_FIELD_NUMBER: _ClassVar[int]
    LEFT_OUT_FIELD_NUMBER: _ClassVar[int]
    NUMBERS_FIELD_NUMBER: _ClassVar[int]
    FAULT_FIELD_NUMBER: _ClassVar[int]
    ENGINE_FIELD_NUMBER: _ClassVar[int]
    SIGNATURE_FIELD_NUMBER: _ClassVar[int]
    event_sequence: int
    run_id: str
    sequence: int
    sensor: str
    t_utc_ns: int
    start_s: float
    stop_s: float
    position: str
    used: bool
    reason: str
    points: int
    left_out: int
    numbers: _containers.ScalarMap[str, float]
    fault: str
    engine: str
    signature: bytes
    def __init__(self, event_sequence: _Optional[int] = ..., run_id: _Optional[str] = ..., sequence: _Optional[int] = ..., sensor: _Optional[str] = ..., t_utc_ns: _Optional[int] = ..., start_s: _Optional[float] = ..., stop_s: _Optional[float] = ..., position: _Optional[str] = ..., used: _Optional[bool] = ..., reason: _Optional[str] = ..., points: _Optional[int] = ..., left_out: _Optional[int] = ..., numbers: _Optional[_Mapping[str, float]] = ..., fault: _Optional[str] = ..., engine: _Optional[str] = ..., signature: _Optional[bytes] = ...) -> None: ...

class Calibration(_message.Message):
    __slots__ = ("event_sequence", "run_id", "sequence", "sensor", "t_utc_ns", "sxx", "sxy", "sxz", "syx", "syy", "syz", "szx", "szy", "szz", "qx", "qy", "qz", "u_sxx", "u_sxy", "u_sxz", "u_syx", "u_syy", "u_syz", "u_szx", "u_szy", "u_szz", "u_qx", "u_qy", "u_qz", "coverage_factor", "residual_sd_x", "residual_sd_y", "residual_sd_z", "windows", "method", "uncertainty_kind", "output_unit", "identity", "determined", "covariance", "reference_temperature_degc", "temperature_low_degc", "temperature_high_degc", "offset_temperature", "u_offset_temperature", "sensitivity_temperature", "u_sensitivity_temperature", "offset_rate", "u_offset_rate", "made_run_id", "made_sequence", "made_utc_ns", "references", "reference_frequency_hz", "valid_band_hz", "sensitivity_at_0hz", "response", "shared_errors", "made_engine", "budget", "degrees_of_freedom", "sensitivity_per_k", "u_sensitivity_per_k", "engine", "signature")
    class Steady(_message.Message):
        __slots__ = ("sensitivity", "standard_uncertainty")
        SENSITIVITY_FIELD_NUMBER: _ClassVar[int]
        STANDARD_UNCERTAINTY_FIELD_NUMBER: _ClassVar[int]
        sensitivity: _containers.RepeatedScalarFieldContainer[float]
        standard_uncertainty: _containers.RepeatedScalarFieldContainer[float]
        def __init__(self, sensitivity: _Optional[_Iterable[float]] = ..., standard_uncertainty: _Optional[_Iterable[float]] = ...) -> None: ...
    class Band(_message.Message):
        __slots__ = ("low_hz", "high_hz", "sensitivity_re", "sensitivity_im", "standard_uncertainty")
        LOW_HZ_FIELD_NUMBER: _ClassVar[int]
        HIGH_HZ_FIELD_NUMBER: _ClassVar[int]
        SENSITIVITY_RE_FIELD_NUMBER: _ClassVar[int]
        SENSITIVITY_IM_FIELD_NUMBER: _ClassVar[int]
        STANDARD_UNCERTAINTY_FIELD_NUMBER: _ClassVar[int]
        low_hz: float
        high_hz: float
        sensitivity_re: _containers.RepeatedScalarFieldContainer[float]
        sensitivity_im: _containers.RepeatedScalarFieldContainer[float]
        standard_uncertainty: _containers.RepeatedScalarFieldContainer[float]
        def __init__(self, low_hz: _Optional[float] = ..., high_hz: _Optional[float] = ..., sensitivity_re: _Optional[_Iterable[float]] = ..., sensitivity_im: _Optional[_Iterable[float]] = ..., standard_uncertainty: _Optional[_Iterable[float]] = ...) -> None: ...
    class SharedError(_message.Message):
        __slots__ = ("reference", "serial_number", "certificate_sha256", "sensitivity", "unknowns", "stated", "u_stated", "value", "own_derivative", "derivative", "kinds")
        REFERENCE_FIELD_NUMBER: _ClassVar[int]
        SERIAL_NUMBER_FIELD_NUMBER: _ClassVar[int]
        CERTIFICATE_SHA256_FIELD_NUMBER: _ClassVar[int]
        SENSITIVITY_FIELD_NUMBER: _ClassVar[int]
        UNKNOWNS_FIELD_NUMBER: _ClassVar[int]
        STATED_FIELD_NUMBER: _ClassVar[int]
        U_STATED_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        OWN_DERIVATIVE_FIELD_NUMBER: _ClassVar[int]
        DERIVATIVE_FIELD_NUMBER: _ClassVar[int]
        KINDS_FIELD_NUMBER: _ClassVar[int]
        reference: str
        serial_number: str
        certificate_sha256: str
        sensitivity: _containers.RepeatedScalarFieldContainer[float]
        unknowns: _containers.RepeatedScalarFieldContainer[str]
        stated: _containers.RepeatedScalarFieldContainer[float]
        u_stated: _containers.RepeatedScalarFieldContainer[float]
        value: _containers.RepeatedScalarFieldContainer[float]
        own_derivative: _containers.RepeatedScalarFieldContainer[float]
        derivative: _containers.RepeatedScalarFieldContainer[float]
        kinds: _containers.RepeatedScalarFieldContainer[str]
        def __init__(self, reference: _Optional[str] = ..., serial_number: _Optional[str] = ..., certificate_sha256: _Optional[str] = ..., sensitivity: _Optional[_Iterable[float]] = ..., unknowns: _Optional[_Iterable[str]] = ..., stated: _Optional[_Iterable[float]] = ..., u_stated: _Optional[_Iterable[float]] = ..., value: _Optional[_Iterable[float]] = ..., own_derivative: _Optional[_Iterable[float]] = ..., derivative: _Optional[_Iterable[float]] = ..., kinds: _Optional[_Iterable[str]] = ...) -> None: ...
    class Source(_message.Message):
        __slots__ = ("name", "standard_uncertainty")
        NAME_FIELD_NUMBER: _ClassVar[int]
        STANDARD_UNCERTAINTY_FIELD_NUMBER: _ClassVar[int]
        name: str
        standard_uncertainty: _containers.RepeatedScalarFieldContainer[float]
        def __init__(self, name: _Optional[str] = ..., standard_uncertainty: _Optional[_Iterable[float]] = ...) -> None: ...
    EVENT_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    RUN_ID_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    SENSOR_FIELD_NUMBER: _ClassVar[int]
    T_UTC_NS_FIELD_NUMBER: _ClassVar[int]
    SXX_FIELD_NUMBER: _ClassVar[int]
    SXY_FIELD_NUMBER: _ClassVar[int]
    SXZ_FIELD_NUMBER: _ClassVar[int]
    SYX_FIELD_NUMBER: _ClassVar[int]
    SYY_FIELD_NUMBER: _ClassVar[int]
    SYZ_FIELD_NUMBER: _ClassVar[int]
    SZX_FIELD_NUMBER: _ClassVar[int]
    SZY_FIELD_NUMBER: _ClassVar[int]
    SZZ_FIELD_NUMBER: _ClassVar[int]
    QX_FIELD_NUMBER: _ClassVar[int]
    QY_FIELD_NUMBER: _ClassVar[int]
    QZ_FIELD_NUMBER: _ClassVar[int]
    U_SXX_FIELD_NUMBER: _ClassVar[int]
    U_SXY_FIELD_NUMBER: _ClassVar[int]
    U_SXZ_FIELD_NUMBER: _ClassVar[int]
    U_SYX_FIELD_NUMBER: _ClassVar[int]
    U_SYY_FIELD_NUMBER: _ClassVar[int]
    U_SYZ_FIELD_NUMBER: _ClassVar[int]
    U_SZX_FIELD_NUMBER: _ClassVar[int]
    U_SZY_FIELD_NUMBER: _ClassVar[int]
    U_SZZ_FIELD_NUMBER: _ClassVar[int]
    U_QX_FIELD_NUMBER: _ClassVar[int]
    U_QY_FIELD_NUMBER: _ClassVar[int]
    U_QZ_FIELD_NUMBER: _ClassVar[int]
    COVERAGE_FACTOR_FIELD_NUMBER: _ClassVar[int]
    RESIDUAL_SD_X_FIELD_NUMBER: _ClassVar[int]
    RESIDUAL_SD_Y_FIELD_NUMBER: _ClassVar[int]
    RESIDUAL_SD_Z_FIELD_NUMBER: _ClassVar[int]
    WINDOWS_FIELD_NUMBER: _ClassVar[int]
    METHOD_FIELD_NUMBER: _ClassVar[int]
    UNCERTAINTY_KIND_FIELD_NUMBER: _ClassVar[int]
    OUTPUT_UNIT_FIELD_NUMBER: _ClassVar[int]
    IDENTITY_FIELD_NUMBER: _ClassVar[int]
    DETERMINED_FIELD_NUMBER: _ClassVar[int]
    COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    REFERENCE_TEMPERATURE_DEGC_FIELD_NUMBER: _ClassVar[int]
    TEMPERATURE_LOW_DEGC_FIELD_NUMBER: _ClassVar[int]
    TEMPERATURE_HIGH_DEGC_FIELD_NUMBER: _ClassVar[int]
    OFFSET_TEMPERATURE_FIELD_NUMBER: _ClassVar[int]
    U_OFFSET_TEMPERATURE_FIELD_NUMBER: _ClassVar[int]
    SENSITIVITY_TEMPERATURE_FIELD_NUMBER: _ClassVar[int]
    U_SENSITIVITY_TEMPERATURE_FIELD_NUMBER: _ClassVar[int]
    OFFSET_RATE_FIELD_NUMBER: _ClassVar[int]
    U_OFFSET_RATE_FIELD_NUMBER: _ClassVar[int]
    MADE_RUN_ID_FIELD_NUMBER: _ClassVar[int]
    MADE_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    MADE_UTC_NS_FIELD_NUMBER: _ClassVar[int]
    REFERENCES_FIELD_NUMBER: _ClassVar[int]
    REFERENCE_FREQUENCY_HZ_FIELD_NUMBER: _ClassVar[int]
    VALID_BAND_HZ_FIELD_NUMBER: _ClassVar[int]
    SENSITIVITY_AT_0HZ_FIELD_NUMBER: _ClassVar[int]
    RESPONSE_FIELD_NUMBER: _ClassVar[int]
    SHARED_ERRORS_FIELD_NUMBER: _ClassVar[int]
    MADE_ENGINE_FIELD_NUMBER: _ClassVar[int]
    BUDGET_FIELD_NUMBER: _ClassVar[int]
    DEGREES_OF_FREEDOM_FIELD_NUMBER: _ClassVar[int]
    SENSITIVITY_PER_K_FIELD_NUMBER: _ClassVar[int]
    U_SENSITIVITY_PER_K_FIELD_NUMBER: _ClassVar[int]
    ENGINE_FIELD_NUMBER: _ClassVar[int]
    SIGNATURE_FIELD_NUMBER: _ClassVar[int]
    event_sequence: int
    run_id: str
    sequence: int
    sensor: str
    t_utc_ns: int
    sxx: float
    sxy: float
    sxz: float
    syx: float
    syy: float
    syz: float
    szx: float
    szy: float
    szz: float
    qx: float
    qy: float
    qz: float
    u_sxx: float
    u_sxy: float
    u_sxz: float
    u_syx: float
    u_syy: float
    u_syz: float
    u_szx: float
    u_szy: float
    u_szz: float
    u_qx: float
    u_qy: float
    u_qz: float
    coverage_factor: float
    residual_sd_x: float
    residual_sd_y: float
    residual_sd_z: float
    windows: int
    method: str
    uncertainty_kind: str
    output_unit: str
    identity: str
    determined: _containers.RepeatedScalarFieldContainer[bool]
    covariance: _containers.RepeatedScalarFieldContainer[float]
    reference_temperature_degc: float
    temperature_low_degc: float
    temperature_high_degc: float
    offset_temperature: _containers.RepeatedScalarFieldContainer[float]
    u_offset_temperature: _containers.RepeatedScalarFieldContainer[float]
    sensitivity_temperature: _containers.RepeatedScalarFieldContainer[float]
    u_sensitivity_temperature: _containers.RepeatedScalarFieldContainer[float]
    offset_rate: _containers.RepeatedScalarFieldContainer[float]
    u_offset_rate: _containers.RepeatedScalarFieldContainer[float]
    made_run_id: str
    made_sequence: int
    made_utc_ns: int
    references: _containers.RepeatedScalarFieldContainer[str]
    reference_frequency_hz: float
    valid_band_hz: _containers.RepeatedScalarFieldContainer[float]
    sensitivity_at_0hz: Calibration.Steady
    response: _containers.RepeatedCompositeFieldContainer[Calibration.Band]
    shared_errors: _containers.RepeatedCompositeFieldContainer[Calibration.SharedError]
    made_engine: str
    budget: _containers.RepeatedCompositeFieldContainer[Calibration.Source]
    degrees_of_freedom: _containers.RepeatedScalarFieldContainer[float]
    sensitivity_per_k: _containers.RepeatedScalarFieldContainer[float]
    u_sensitivity_per_k: _containers.RepeatedScalarFieldContainer[float]
    engine: str
    signature: bytes
    def __init__(self, event_sequence: _Optional[int] = ..., run_id: _Optional[str] = ..., sequence: _Optional[int] = ..., sensor: _Optional[str] = ..., t_utc_ns: _Optional[int] = ..., sxx: _Optional[float] = ..., sxy: _Optional[float] = ..., sxz: _Optional[float] = ..., syx: _Optional[float] = ..., syy: _Optional[float] = ..., syz: _Optional[float] = ..., szx: _Optional[float] = ..., szy: _Optional[float] = ..., szz: _Optional[float] = ..., qx: _Optional[float] = ..., qy: _Optional[float] = ..., qz: _Optional[float] = ..., u_sxx: _Optional[float] = ..., u_sxy: _Optional[float] = ..., u_sxz: _Optional[float] = ..., u_syx: _Optional[float] = ..., u_syy: _Optional[float] = ..., u_syz: _Optional[float] = ..., u_szx: _Optional[float] = ..., u_szy: _Optional[float] = ..., u_szz: _Optional[float] = ..., u_qx: _Optional[float] = ..., u_qy: _Optional[float] = ..., u_qz: _Optional[float] = ..., coverage_factor: _Optional[float] = ..., residual_sd_x: _Optional[float] = ..., residual_sd_y: _Optional[float] = ..., residual_sd_z: _Optional[float] = ..., windows: _Optional[int] = ..., method: _Optional[str] = ..., uncertainty_kind: _Optional[str] = ..., output_unit: _Optional[str] = ..., identity: _Optional[str] = ..., determined: _Optional[_Iterable[bool]] = ..., covariance: _Optional[_Iterable[float]] = ..., reference_temperature_degc: _Optional[float] = ..., temperature_low_degc: _Optional[float] = ..., temperature_high_degc: _Optional[float] = ..., offset_temperature: _Optional[_Iterable[float]] = ..., u_offset_temperature: _Optional[_Iterable[float]] = ..., sensitivity_temperature: _Optional[_Iterable[float]] = ..., u_sensitivity_temperature: _Optional[_Iterable[float]] = ..., offset_rate: _Optional[_Iterable[float]] = ..., u_offset_rate: _Optional[_Iterable[float]] = ..., made_run_id: _Optional[str] = ..., made_sequence: _Optional[int] = ..., made_utc_ns: _Optional[int] = ..., references: _Optional[_Iterable[str]] = ..., reference_frequency_hz: _Optional[float] = ..., valid_band_hz: _Optional[_Iterable[float]] = ..., sensitivity_at_0hz: _Optional[_Union[Calibration.Steady, _Mapping]] = ..., response: _Optional[_Iterable[_Union[Calibration.Band, _Mapping]]] = ..., shared_errors: _Optional[_Iterable[_Union[Calibration.SharedError, _Mapping]]] = ..., made_engine: _Optional[str] = ..., budget: _Optional[_Iterable[_Union[Calibration.Source, _Mapping]]] = ..., degrees_of_freedom: _Optional[_Iterable[float]] = ..., sensitivity_per_k: _Optional[_Iterable[float]] = ..., u_sensitivity_per_k: _Optional[_Iterable[float]] = ..., engine: _Optional[str] = ..., signature: _Optional[bytes] = ...) -> None: ...

class Status(_message.Message):
    __slots__ = ("event_sequence", "run_id", "sequence", "sensor", "t_utc_ns", "status", "before", "reason", "engine", "signature")
    EVENT_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    RUN_ID_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    SENSOR_FIELD_NUMBER: _ClassVar[int]
    T_UTC_NS_FIELD_NUMBER: _ClassVar[int]
    STATUS_FIELD_NUMBER: _ClassVar[int]
    BEFORE_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    ENGINE_FIELD_NUMBER: _ClassVar[int]
    SIGNATURE_FIELD_NUMBER: _ClassVar[int]
    event_sequence: int
    run_id: str
    sequence: int
    sensor: str
    t_utc_ns: int
    status: str
    before: str
    reason: str
    engine: str
    signature: bytes
    def __init__(self, event_sequence: _Optional[int] = ..., run_id: _Optional[str] = ..., sequence: _Optional[int] = ..., sensor: _Optional[str] = ..., t_utc_ns: _Optional[int] = ..., status: _Optional[str] = ..., before: _Optional[str] = ..., reason: _Optional[str] = ..., engine: _Optional[str] = ..., signature: _Optional[bytes] = ...) -> None: ...

class Estimate(_message.Message):
    __slots__ = ("event_sequence", "run_id", "sequence", "sensor", "t_utc_ns", "reason", "calibration", "engine", "signature")
    EVENT_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    RUN_ID_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    SENSOR_FIELD_NUMBER: _ClassVar[int]
    T_UTC_NS_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    CALIBRATION_FIELD_NUMBER: _ClassVar[int]
    ENGINE_FIELD_NUMBER: _ClassVar[int]
    SIGNATURE_FIELD_NUMBER: _ClassVar[int]
    event_sequence: int
    run_id: str
    sequence: int
    sensor: str
    t_utc_ns: int
    reason: str
    calibration: bytes
    engine: str
    signature: bytes
    def __init__(self, event_sequence: _Optional[int] = ..., run_id: _Optional[str] = ..., sequence: _Optional[int] = ..., sensor: _Optional[str] = ..., t_utc_ns: _Optional[int] = ..., reason: _Optional[str] = ..., calibration: _Optional[bytes] = ..., engine: _Optional[str] = ..., signature: _Optional[bytes] = ...) -> None: ...

class Drift(_message.Message):
    __slots__ = ("event_sequence", "run_id", "sequence", "sensor", "t_utc_ns", "parameter", "verdict", "change", "u_change", "rate", "u_rate", "onset_utc_ns", "statistic", "threshold", "false_alarms_a_year", "reason", "engine", "signature")
    EVENT_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    RUN_ID_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    SENSOR_FIELD_NUMBER: _ClassVar[int]
    T_UTC_NS_FIELD_NUMBER: _ClassVar[int]
    PARAMETER_FIELD_NUMBER: _ClassVar[int]
    VERDICT_FIELD_NUMBER: _ClassVar[int]
    CHANGE_FIELD_NUMBER: _ClassVar[int]
    U_CHANGE_FIELD_NUMBER: _ClassVar[int]
    RATE_FIELD_NUMBER: _ClassVar[int]
    U_RATE_FIELD_NUMBER: _ClassVar[int]
    ONSET_UTC_NS_FIELD_NUMBER: _ClassVar[int]
    STATISTIC_FIELD_NUMBER: _ClassVar[int]
    THRESHOLD_FIELD_NUMBER: _ClassVar[int]
    FALSE_ALARMS_A_YEAR_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    ENGINE_FIELD_NUMBER: _ClassVar[int]
    SIGNATURE_FIELD_NUMBER: _ClassVar[int]
    event_sequence: int
    run_id: str
    sequence: int
    sensor: str
    t_utc_ns: int
    parameter: str
    verdict: str
    change: float
    u_change: float
    rate: float
    u_rate: float
    onset_utc_ns: int
    statistic: float
    threshold: float
    false_alarms_a_year: float
    reason: str
    engine: str
    signature: bytes
    def __init__(self, event_sequence: _Optional[int] = ..., run_id: _Optional[str] = ..., sequence: _Optional[int] = ..., sensor: _Optional[str] = ..., t_utc_ns: _Optional[int] = ..., parameter: _Optional[str] = ..., verdict: _Optional[str] = ..., change: _Optional[float] = ..., u_change: _Optional[float] = ..., rate: _Optional[float] = ..., u_rate: _Optional[float] = ..., onset_utc_ns: _Optional[int] = ..., statistic: _Optional[float] = ..., threshold: _Optional[float] = ..., false_alarms_a_year: _Optional[float] = ..., reason: _Optional[str] = ..., engine: _Optional[str] = ..., signature: _Optional[bytes] = ...) -> None: ...

class Clock(_message.Message):
    __slots__ = ("event_sequence", "run_id", "sequence", "sensor", "t_utc_ns", "device", "role", "nominal_rate_hz", "rate_hz", "u_rate_hz", "offset_s", "u_offset_s", "jitter_s", "lag_s", "u_lag_s", "arrivals", "engine", "signature")
    EVENT_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    RUN_ID_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    SENSOR_FIELD_NUMBER: _ClassVar[int]
    T_UTC_NS_FIELD_NUMBER: _ClassVar[int]
    DEVICE_FIELD_NUMBER: _ClassVar[int]
    ROLE_FIELD_NUMBER: _ClassVar[int]
    NOMINAL_RATE_HZ_FIELD_NUMBER: _ClassVar[int]
    RATE_HZ_FIELD_NUMBER: _ClassVar[int]
    U_RATE_HZ_FIELD_NUMBER: _ClassVar[int]
    OFFSET_S_FIELD_NUMBER: _ClassVar[int]
    U_OFFSET_S_FIELD_NUMBER: _ClassVar[int]
    JITTER_S_FIELD_NUMBER: _ClassVar[int]
    LAG_S_FIELD_NUMBER: _ClassVar[int]
    U_LAG_S_FIELD_NUMBER: _ClassVar[int]
    ARRIVALS_FIELD_NUMBER: _ClassVar[int]
    ENGINE_FIELD_NUMBER: _ClassVar[int]
    SIGNATURE_FIELD_NUMBER: _ClassVar[int]
    event_sequence: int
    run_id: str
    sequence: int
    sensor: str
    t_utc_ns: int
    device: str
    role: str
    nominal_rate_hz: float
    rate_hz: float
    u_rate_hz: float
    offset_s: float
    u_offset_s: float
    jitter_s: float
    lag_s: float
    u_lag_s: float
    arrivals: int
    engine: str
    signature: bytes
    def __init__(self, event_sequence: _Optional[int] = ..., run_id: _Optional[str] = ..., sequence: _Optional[int] = ..., sensor: _Optional[str] = ..., t_utc_ns: _Optional[int] = ..., device: _Optional[str] = ..., role: _Optional[str] = ..., nominal_rate_hz: _Optional[float] = ..., rate_hz: _Optional[float] = ..., u_rate_hz: _Optional[float] = ..., offset_s: _Optional[float] = ..., u_offset_s: _Optional[float] = ..., jitter_s: _Optional[float] = ..., lag_s: _Optional[float] = ..., u_lag_s: _Optional[float] = ..., arrivals: _Optional[int] = ..., engine: _Optional[str] = ..., signature: _Optional[bytes] = ...) -> None: ...

class Acceleration(_message.Message):
    __slots__ = ("event_sequence", "sensor", "t_utc_ns", "first_index", "rate_hz", "x", "y", "z", "covariance", "noise", "determined", "calibration_run_id", "calibration_sequence", "dynamic_only", "suspect")
    EVENT_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    SENSOR_FIELD_NUMBER: _ClassVar[int]
    T_UTC_NS_FIELD_NUMBER: _ClassVar[int]
    FIRST_INDEX_FIELD_NUMBER: _ClassVar[int]
    RATE_HZ_FIELD_NUMBER: _ClassVar[int]
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    Z_FIELD_NUMBER: _ClassVar[int]
    COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    NOISE_FIELD_NUMBER: _ClassVar[int]
    DETERMINED_FIELD_NUMBER: _ClassVar[int]
    CALIBRATION_RUN_ID_FIELD_NUMBER: _ClassVar[int]
    CALIBRATION_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    DYNAMIC_ONLY_FIELD_NUMBER: _ClassVar[int]
    SUSPECT_FIELD_NUMBER: _ClassVar[int]
    event_sequence: int
    sensor: str
    t_utc_ns: int
    first_index: int
    rate_hz: float
    x: _containers.RepeatedScalarFieldContainer[float]
    y: _containers.RepeatedScalarFieldContainer[float]
    z: _containers.RepeatedScalarFieldContainer[float]
    covariance: _containers.RepeatedScalarFieldContainer[float]
    noise: _containers.RepeatedScalarFieldContainer[float]
    determined: _containers.RepeatedScalarFieldContainer[bool]
    calibration_run_id: str
    calibration_sequence: int
    dynamic_only: bool
    suspect: _containers.RepeatedScalarFieldContainer[bool]
    def __init__(self, event_sequence: _Optional[int] = ..., sensor: _Optional[str] = ..., t_utc_ns: _Optional[int] = ..., first_index: _Optional[int] = ..., rate_hz: _Optional[float] = ..., x: _Optional[_Iterable[float]] = ..., y: _Optional[_Iterable[float]] = ..., z: _Optional[_Iterable[float]] = ..., covariance: _Optional[_Iterable[float]] = ..., noise: _Optional[_Iterable[float]] = ..., determined: _Optional[_Iterable[bool]] = ..., calibration_run_id: _Optional[str] = ..., calibration_sequence: _Optional[int] = ..., dynamic_only: _Optional[bool] = ..., suspect: _Optional[_Iterable[bool]] = ...) -> None: ...

class AccelerationBytes(_message.Message):
    __slots__ = ("event_sequence", "sensor", "t_utc_ns", "first_index", "rate_hz", "x", "y", "z", "covariance", "noise", "determined", "calibration_run_id", "calibration_sequence", "dynamic_only", "suspect")
    EVENT_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    SENSOR_FIELD_NUMBER: _ClassVar[int]
    T_UTC_NS_FIELD_NUMBER: _ClassVar[int]
    FIRST_INDEX_FIELD_NUMBER: _ClassVar[int]
    RATE_HZ_FIELD_NUMBER: _ClassVar[int]
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    Z_FIELD_NUMBER: _ClassVar[int]
    COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    NOISE_FIELD_NUMBER: _ClassVar[int]
    DETERMINED_FIELD_NUMBER: _ClassVar[int]
    CALIBRATION_RUN_ID_FIELD_NUMBER: _ClassVar[int]
    CALIBRATION_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    DYNAMIC_ONLY_FIELD_NUMBER: _ClassVar[int]
    SUSPECT_FIELD_NUMBER: _ClassVar[int]
    event_sequence: int
    sensor: str
    t_utc_ns: int
    first_index: int
    rate_hz: float
    x: bytes
    y: bytes
    z: bytes
    covariance: bytes
    noise: bytes
    determined: _containers.RepeatedScalarFieldContainer[bool]
    calibration_run_id: str
    calibration_sequence: int
    dynamic_only: bool
    suspect: _containers.RepeatedScalarFieldContainer[bool]
    def __init__(self, event_sequence: _Optional[int] = ..., sensor: _Optional[str] = ..., t_utc_ns: _Optional[int] = ..., first_index: _Optional[int] = ..., rate_hz: _Optional[float] = ..., x: _Optional[bytes] = ..., y: _Optional[bytes] = ..., z: _Optional[bytes] = ..., covariance: _Optional[bytes] = ..., noise: _Optional[bytes] = ..., determined: _Optional[_Iterable[bool]] = ..., calibration_run_id: _Optional[str] = ..., calibration_sequence: _Optional[int] = ..., dynamic_only: _Optional[bool] = ..., suspect: _Optional[_Iterable[bool]] = ...) -> None: ...
