"""The exception tree.

FcslamError
├── InputError            something the user gave is wrong: one line says what, where, what to do (exit code 2)
│   ├── SourceError       a recording cannot be read
│   ├── ConfigError       a configuration file, a key of it or a veto is wrong
│   ├── OutputError       the output folder cannot be used
│   ├── SimulationError   a fleet cannot be simulated
│   ├── FeatureError      network weights, images or extracted features cannot be used
│   ├── TrainingError     a detector cannot be trained: images, settings or a checkpoint are unusable
│   ├── EvaluationError   a reference file or a run folder cannot be evaluated
│   ├── ServiceError      the cloud service cannot do as it is told: tokens, certificates, address, folder, mission
│   ├── StoreError        a mission cannot be kept or read: the disk is full, the file is broken or something else
│   ├── StateError        a robot's state folder cannot be used
│   └── CloudError        the cloud turns a robot away: its token, its name or what it sends
│       └── OversizeError     it takes nothing so large at once
├── PacketError           bytes received are not a packet that may be trusted
│   └── PacketConflictError   two different packets have one number
└── UnavailableError      the cloud cannot be reached or is busy: try again
"""


class FcslamError(Exception):
    """Everything that fcslam raises on purpose."""


class InputError(FcslamError):
    """Something the user gave is wrong; the message says what, where and what to do."""


class SourceError(InputError):
    """A recording cannot be read."""


class ConfigError(InputError):
    """A configuration file, one of its keys or a veto is wrong."""


class OutputError(InputError):
    """The output folder cannot be used."""


class SimulationError(InputError):
    """A fleet cannot be simulated: the building is too small for it, or a library is missing."""


class FeatureError(InputError):
    """Network weights, images or extracted features cannot be used."""


class TrainingError(InputError):
    """A detector cannot be trained: images, a teacher's points or a checkpoint do not serve, or torch is missing."""


class EvaluationError(InputError):
    """A reference file or a run folder cannot be evaluated."""


class StateError(InputError):
    """A robot's state folder is another robot's, in use, damaged, or not what the recording says."""


class CloudError(InputError):
    """The cloud turns a robot away, and will again: its token, its name, its certificate, or what it sends."""


class OversizeError(CloudError):
    """The cloud, or what stands before it, takes no request of this size; a smaller one may pass."""


class UnavailableError(FcslamError):
    """The cloud cannot be reached or has no time; the same request may succeed later."""

    def __init__(self, message: str, retry_after_s: float = 0.0) -> None:
        super().__init__(message)
        self.retry_after_s = retry_after_s
        """The cloud asks not to be asked before; 0: it says nothing."""


class ServiceError(InputError):
    """The cloud service cannot do as it is told: tokens, certificates, address, folder or mission do not serve."""


class StoreError(InputError):
    """A mission cannot be kept or read: the disk is full, or the file is broken or no mission."""


class PacketError(FcslamError):
    """Bytes received are not a packet that may be trusted; the message says why."""


class PacketConflictError(PacketError):
    """A packet has the number of another one that is stored already."""

    def __init__(self, message: str, index: int) -> None:
        super().__init__(message)
        self.index = index
        """Of the packet among those that were given."""
