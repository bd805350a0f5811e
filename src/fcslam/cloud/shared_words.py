"""Words that robots send in place of descriptors: which the cloud knows, and what they stand for."""

from collections.abc import Mapping

from fcslam.cloud.settings import FleetConfig
from fcslam.errors import PacketError
from fcslam.places.matcher import MatchDecision
from fcslam.places.words import WordVocabulary, read_vocabularies, short
from fcslam.records import Channel, Keyscan, Place, WordPlace
from fcslam.wire.messages import Hello


class SharedWords:
    """The vocabularies that the settings name."""

    def __init__(self, config: FleetConfig) -> None:
        """Read them.

        Raises:
            InputError: a file cannot be read.
        """
        found = (vocabulary for path in config.vocabularies for vocabulary in read_vocabularies(path))
        self._by_digest: dict[bytes, WordVocabulary] = {vocabulary.digest: vocabulary for vocabulary in found}
        self._takes_words = config.matcher.decision is MatchDecision.SIMILARITY

    def check_hello(self, hello: Hello) -> None:
        """Check that the cloud has the words that a robot is going to send.

        Raises:
            PacketError: it has not, or it verifies places by geometry, for which words do not suffice.
        """
        if hello.vocabularies:
            self._check_decision(f"{hello.robot}: sends words")
        for channel, digest in hello.vocabularies.items():
            known = self._by_digest.get(digest)
            if known is None:
                there = ", ".join(map(short, self._by_digest)) or "none"
                raise PacketError(
                    f"{hello.robot}: sends words of {channel} vocabulary {short(digest)}; the cloud has {there} "
                    "(fleet.vocabularies)"
                )
            version = hello.detector_versions[channel]
            if (known.channel, known.detector_version) != (channel, version):
                raise PacketError(
                    f"{hello.robot}: vocabulary {short(digest)} is of {known.channel} detector "
                    f"{known.detector_version}, not of {channel} detector {version}"
                )

    def check_keyscan(self, keyscan: Keyscan) -> None:
        """Check that the cloud can do without the ranges of a keyscan that has none.

        Raises:
            PacketError: it cannot.
        """
        if not len(keyscan.ranges_m):
            self._check_decision(f"{keyscan.id.robot}: sends keyscan {keyscan.id.number} without ranges")

    def place(self, place: WordPlace, announced: Mapping[Channel, bytes]) -> Place:
        """The place whose descriptors are the centres of its words.

        ``announced``: digests of the vocabularies of the robot's hello.

        Raises:
            PacketError: the robot announced no vocabulary for it, or a word is not in it.
        """
        digest, name = announced.get(place.channel), f"{place.id.robot}: {place.channel} place {place.id.number}"
        if digest is None:
            raise PacketError(f"{name} has words, but no vocabulary was announced")
        try:
            centres = self._by_digest[digest].descriptors(place.words)
        except ValueError as error:
            raise PacketError(f"{name}: {error}") from error
        return Place(place.id, place.channel, place.detector_version, place.first, place.last, place.keypoints, centres)

    def _check_decision(self, what: str) -> None:
        if not self._takes_words:
            raise PacketError(f"{what}; the cloud verifies places by geometry (fleet.matcher.decision)")
