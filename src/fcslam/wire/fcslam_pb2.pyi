from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Channel(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    CHANNEL_UNSPECIFIED: _ClassVar[Channel]
    CHANNEL_LIDAR: _ClassVar[Channel]
    CHANNEL_CAMERA: _ClassVar[Channel]

class ConstraintKind(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    CONSTRAINT_KIND_UNSPECIFIED: _ClassVar[ConstraintKind]
    CONSTRAINT_KIND_ODOMETRY: _ClassVar[ConstraintKind]
    CONSTRAINT_KIND_CLOSURE: _ClassVar[ConstraintKind]
CHANNEL_UNSPECIFIED: Channel
CHANNEL_LIDAR: Channel
CHANNEL_CAMERA: Channel
CONSTRAINT_KIND_UNSPECIFIED: ConstraintKind
CONSTRAINT_KIND_ODOMETRY: ConstraintKind
CONSTRAINT_KIND_CLOSURE: ConstraintKind

class Packet(_message.Message):
    __slots__ = ("version", "robot", "epoch", "sequence", "time", "hello", "keyscan", "constraint", "place", "tag_sighting", "keyscan_fix", "voxel_map", "correction", "acknowledgement", "detector_update")
    VERSION_FIELD_NUMBER: _ClassVar[int]
    ROBOT_FIELD_NUMBER: _ClassVar[int]
    EPOCH_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    TIME_FIELD_NUMBER: _ClassVar[int]
    HELLO_FIELD_NUMBER: _ClassVar[int]
    KEYSCAN_FIELD_NUMBER: _ClassVar[int]
    CONSTRAINT_FIELD_NUMBER: _ClassVar[int]
    PLACE_FIELD_NUMBER: _ClassVar[int]
    TAG_SIGHTING_FIELD_NUMBER: _ClassVar[int]
    KEYSCAN_FIX_FIELD_NUMBER: _ClassVar[int]
    VOXEL_MAP_FIELD_NUMBER: _ClassVar[int]
    CORRECTION_FIELD_NUMBER: _ClassVar[int]
    ACKNOWLEDGEMENT_FIELD_NUMBER: _ClassVar[int]
    DETECTOR_UPDATE_FIELD_NUMBER: _ClassVar[int]
    version: int
    robot: str
    epoch: int
    sequence: int
    time: float
    hello: Hello
    keyscan: Keyscan
    constraint: Constraint
    place: Place
    tag_sighting: TagSighting
    keyscan_fix: KeyscanFix
    voxel_map: VoxelMap
    correction: Correction
    acknowledgement: Acknowledgement
    detector_update: DetectorUpdate
    def __init__(self, version: _Optional[int] = ..., robot: _Optional[str] = ..., epoch: _Optional[int] = ..., sequence: _Optional[int] = ..., time: _Optional[float] = ..., hello: _Optional[_Union[Hello, _Mapping]] = ..., keyscan: _Optional[_Union[Keyscan, _Mapping]] = ..., constraint: _Optional[_Union[Constraint, _Mapping]] = ..., place: _Optional[_Union[Place, _Mapping]] = ..., tag_sighting: _Optional[_Union[TagSighting, _Mapping]] = ..., keyscan_fix: _Optional[_Union[KeyscanFix, _Mapping]] = ..., voxel_map: _Optional[_Union[VoxelMap, _Mapping]] = ..., correction: _Optional[_Union[Correction, _Mapping]] = ..., acknowledgement: _Optional[_Union[Acknowledgement, _Mapping]] = ..., detector_update: _Optional[_Union[DetectorUpdate, _Mapping]] = ...) -> None: ...

class Pose(_message.Message):
    __slots__ = ("x_m", "y_m", "theta_rad")
    X_M_FIELD_NUMBER: _ClassVar[int]
    Y_M_FIELD_NUMBER: _ClassVar[int]
    THETA_RAD_FIELD_NUMBER: _ClassVar[int]
    x_m: float
    y_m: float
    theta_rad: float
    def __init__(self, x_m: _Optional[float] = ..., y_m: _Optional[float] = ..., theta_rad: _Optional[float] = ...) -> None: ...

class SpacePose(_message.Message):
    __slots__ = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
    X_M_FIELD_NUMBER: _ClassVar[int]
    Y_M_FIELD_NUMBER: _ClassVar[int]
    Z_M_FIELD_NUMBER: _ClassVar[int]
    QX_FIELD_NUMBER: _ClassVar[int]
    QY_FIELD_NUMBER: _ClassVar[int]
    QZ_FIELD_NUMBER: _ClassVar[int]
    QW_FIELD_NUMBER: _ClassVar[int]
    x_m: float
    y_m: float
    z_m: float
    qx: float
    qy: float
    qz: float
    qw: float
    def __init__(self, x_m: _Optional[float] = ..., y_m: _Optional[float] = ..., z_m: _Optional[float] = ..., qx: _Optional[float] = ..., qy: _Optional[float] = ..., qz: _Optional[float] = ..., qw: _Optional[float] = ...) -> None: ...

class Hello(_message.Message):
    __slots__ = ("lasers", "detectors", "floor")
    LASERS_FIELD_NUMBER: _ClassVar[int]
    DETECTORS_FIELD_NUMBER: _ClassVar[int]
    FLOOR_FIELD_NUMBER: _ClassVar[int]
    lasers: _containers.RepeatedCompositeFieldContainer[Laser]
    detectors: _containers.RepeatedCompositeFieldContainer[Detector]
    floor: str
    def __init__(self, lasers: _Optional[_Iterable[_Union[Laser, _Mapping]]] = ..., detectors: _Optional[_Iterable[_Union[Detector, _Mapping]]] = ..., floor: _Optional[str] = ...) -> None: ...

class Laser(_message.Message):
    __slots__ = ("beam_count", "angle_min_rad", "angle_increment_rad", "max_range_m", "t_base_laser")
    BEAM_COUNT_FIELD_NUMBER: _ClassVar[int]
    ANGLE_MIN_RAD_FIELD_NUMBER: _ClassVar[int]
    ANGLE_INCREMENT_RAD_FIELD_NUMBER: _ClassVar[int]
    MAX_RANGE_M_FIELD_NUMBER: _ClassVar[int]
    T_BASE_LASER_FIELD_NUMBER: _ClassVar[int]
    beam_count: int
    angle_min_rad: float
    angle_increment_rad: float
    max_range_m: float
    t_base_laser: Pose
    def __init__(self, beam_count: _Optional[int] = ..., angle_min_rad: _Optional[float] = ..., angle_increment_rad: _Optional[float] = ..., max_range_m: _Optional[float] = ..., t_base_laser: _Optional[_Union[Pose, _Mapping]] = ...) -> None: ...

class Detector(_message.Message):
    __slots__ = ("channel", "version")
    CHANNEL_FIELD_NUMBER: _ClassVar[int]
    VERSION_FIELD_NUMBER: _ClassVar[int]
    channel: Channel
    version: str
    def __init__(self, channel: _Optional[_Union[Channel, str]] = ..., version: _Optional[str] = ...) -> None: ...

class Keyscan(_message.Message):
    __slots__ = ("number", "stamp", "count", "ranges", "laser", "beams", "sweep")
    NUMBER_FIELD_NUMBER: _ClassVar[int]
    STAMP_FIELD_NUMBER: _ClassVar[int]
    COUNT_FIELD_NUMBER: _ClassVar[int]
    RANGES_FIELD_NUMBER: _ClassVar[int]
    LASER_FIELD_NUMBER: _ClassVar[int]
    BEAMS_FIELD_NUMBER: _ClassVar[int]
    SWEEP_FIELD_NUMBER: _ClassVar[int]
    number: int
    stamp: float
    count: int
    ranges: bytes
    laser: int
    beams: Beams
    sweep: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, number: _Optional[int] = ..., stamp: _Optional[float] = ..., count: _Optional[int] = ..., ranges: _Optional[bytes] = ..., laser: _Optional[int] = ..., beams: _Optional[_Union[Beams, _Mapping]] = ..., sweep: _Optional[_Iterable[int]] = ...) -> None: ...

class Beams(_message.Message):
    __slots__ = ("angle_min_rad", "angle_increment_rad")
    ANGLE_MIN_RAD_FIELD_NUMBER: _ClassVar[int]
    ANGLE_INCREMENT_RAD_FIELD_NUMBER: _ClassVar[int]
    angle_min_rad: float
    angle_increment_rad: float
    def __init__(self, angle_min_rad: _Optional[float] = ..., angle_increment_rad: _Optional[float] = ...) -> None: ...

class Constraint(_message.Message):
    __slots__ = ("i", "j", "kind", "t_i_j", "information", "t_i_j_space")
    I_FIELD_NUMBER: _ClassVar[int]
    J_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    T_I_J_FIELD_NUMBER: _ClassVar[int]
    INFORMATION_FIELD_NUMBER: _ClassVar[int]
    T_I_J_SPACE_FIELD_NUMBER: _ClassVar[int]
    i: int
    j: int
    kind: ConstraintKind
    t_i_j: Pose
    information: _containers.RepeatedScalarFieldContainer[float]
    t_i_j_space: SpacePose
    def __init__(self, i: _Optional[int] = ..., j: _Optional[int] = ..., kind: _Optional[_Union[ConstraintKind, str]] = ..., t_i_j: _Optional[_Union[Pose, _Mapping]] = ..., information: _Optional[_Iterable[float]] = ..., t_i_j_space: _Optional[_Union[SpacePose, _Mapping]] = ...) -> None: ...

class Place(_message.Message):
    __slots__ = ("number", "channel", "detector_version", "first", "last", "count", "keypoints", "descriptors")
    NUMBER_FIELD_NUMBER: _ClassVar[int]
    CHANNEL_FIELD_NUMBER: _ClassVar[int]
    DETECTOR_VERSION_FIELD_NUMBER: _ClassVar[int]
    FIRST_FIELD_NUMBER: _ClassVar[int]
    LAST_FIELD_NUMBER: _ClassVar[int]
    COUNT_FIELD_NUMBER: _ClassVar[int]
    KEYPOINTS_FIELD_NUMBER: _ClassVar[int]
    DESCRIPTORS_FIELD_NUMBER: _ClassVar[int]
    number: int
    channel: Channel
    detector_version: str
    first: int
    last: int
    count: int
    keypoints: bytes
    descriptors: bytes
    def __init__(self, number: _Optional[int] = ..., channel: _Optional[_Union[Channel, str]] = ..., detector_version: _Optional[str] = ..., first: _Optional[int] = ..., last: _Optional[int] = ..., count: _Optional[int] = ..., keypoints: _Optional[bytes] = ..., descriptors: _Optional[bytes] = ...) -> None: ...

class TagSighting(_message.Message):
    __slots__ = ("number", "family", "tag", "t_base_tag", "information")
    NUMBER_FIELD_NUMBER: _ClassVar[int]
    FAMILY_FIELD_NUMBER: _ClassVar[int]
    TAG_FIELD_NUMBER: _ClassVar[int]
    T_BASE_TAG_FIELD_NUMBER: _ClassVar[int]
    INFORMATION_FIELD_NUMBER: _ClassVar[int]
    number: int
    family: str
    tag: int
    t_base_tag: Pose
    information: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, number: _Optional[int] = ..., family: _Optional[str] = ..., tag: _Optional[int] = ..., t_base_tag: _Optional[_Union[Pose, _Mapping]] = ..., information: _Optional[_Iterable[float]] = ...) -> None: ...

class KeyscanFix(_message.Message):
    __slots__ = ("number", "latitude_deg", "longitude_deg", "altitude_m", "sigma_m", "antenna_x_m", "antenna_y_m")
    NUMBER_FIELD_NUMBER: _ClassVar[int]
    LATITUDE_DEG_FIELD_NUMBER: _ClassVar[int]
    LONGITUDE_DEG_FIELD_NUMBER: _ClassVar[int]
    ALTITUDE_M_FIELD_NUMBER: _ClassVar[int]
    SIGMA_M_FIELD_NUMBER: _ClassVar[int]
    ANTENNA_X_M_FIELD_NUMBER: _ClassVar[int]
    ANTENNA_Y_M_FIELD_NUMBER: _ClassVar[int]
    number: int
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    sigma_m: float
    antenna_x_m: float
    antenna_y_m: float
    def __init__(self, number: _Optional[int] = ..., latitude_deg: _Optional[float] = ..., longitude_deg: _Optional[float] = ..., altitude_m: _Optional[float] = ..., sigma_m: _Optional[float] = ..., antenna_x_m: _Optional[float] = ..., antenna_y_m: _Optional[float] = ...) -> None: ...

class VoxelMap(_message.Message):
    __slots__ = ("number", "first", "last", "t_base_ground", "count", "points", "origins")
    NUMBER_FIELD_NUMBER: _ClassVar[int]
    FIRST_FIELD_NUMBER: _ClassVar[int]
    LAST_FIELD_NUMBER: _ClassVar[int]
    T_BASE_GROUND_FIELD_NUMBER: _ClassVar[int]
    COUNT_FIELD_NUMBER: _ClassVar[int]
    POINTS_FIELD_NUMBER: _ClassVar[int]
    ORIGINS_FIELD_NUMBER: _ClassVar[int]
    number: int
    first: int
    last: int
    t_base_ground: SpacePose
    count: int
    points: bytes
    origins: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, number: _Optional[int] = ..., first: _Optional[int] = ..., last: _Optional[int] = ..., t_base_ground: _Optional[_Union[SpacePose, _Mapping]] = ..., count: _Optional[int] = ..., points: _Optional[bytes] = ..., origins: _Optional[_Iterable[int]] = ...) -> None: ...

class Correction(_message.Message):
    __slots__ = ("version", "map_index", "t_map_odom", "quality", "t_map_odom_space")
    VERSION_FIELD_NUMBER: _ClassVar[int]
    MAP_INDEX_FIELD_NUMBER: _ClassVar[int]
    T_MAP_ODOM_FIELD_NUMBER: _ClassVar[int]
    QUALITY_FIELD_NUMBER: _ClassVar[int]
    T_MAP_ODOM_SPACE_FIELD_NUMBER: _ClassVar[int]
    version: int
    map_index: int
    t_map_odom: Pose
    quality: float
    t_map_odom_space: SpacePose
    def __init__(self, version: _Optional[int] = ..., map_index: _Optional[int] = ..., t_map_odom: _Optional[_Union[Pose, _Mapping]] = ..., quality: _Optional[float] = ..., t_map_odom_space: _Optional[_Union[SpacePose, _Mapping]] = ...) -> None: ...

class Acknowledgement(_message.Message):
    __slots__ = ("epoch", "sequence")
    EPOCH_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    epoch: int
    sequence: int
    def __init__(self, epoch: _Optional[int] = ..., sequence: _Optional[int] = ...) -> None: ...

class DetectorUpdate(_message.Message):
    __slots__ = ("channel", "version", "format", "size", "sha256")
    CHANNEL_FIELD_NUMBER: _ClassVar[int]
    VERSION_FIELD_NUMBER: _ClassVar[int]
    FORMAT_FIELD_NUMBER: _ClassVar[int]
    SIZE_FIELD_NUMBER: _ClassVar[int]
    SHA256_FIELD_NUMBER: _ClassVar[int]
    channel: Channel
    version: str
    format: int
    size: int
    sha256: bytes
    def __init__(self, channel: _Optional[_Union[Channel, str]] = ..., version: _Optional[str] = ..., format: _Optional[int] = ..., size: _Optional[int] = ..., sha256: _Optional[bytes] = ...) -> None: ...
