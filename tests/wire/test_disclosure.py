"""Every field of the schema is explained, and nothing that it does not have."""

from fcslam.wire import fcslam_pb2 as pb
from fcslam.wire.disclosure import PLAIN, REVEALS, disclosures
from fcslam.wire.messages import PacketKind


def test_every_field_has_its_words():
    messages = [message for name, message in pb.DESCRIPTOR.message_types_by_name.items() if name not in PLAIN]
    fields = {f"{m.name}.{f.name}" for m in messages for f in m.fields if f.containing_oneof is None}
    assert set(REVEALS) == fields
    assert all(REVEALS.values())


def test_every_message_is_told_with_its_direction():
    told = {message.name: message for message in disclosures()}
    assert list(told) == ["every packet", *PacketKind]
    assert (told["place"].direction, told["correction"].direction) == ("robot to cloud", "cloud to robot")
    assert [field.name for field in told["hello"].fields][-5:] == [
        "detectors",
        "detectors.channel",
        "detectors.version",
        "detectors.vocabulary",
        "floor",
    ]
    (information,) = (field for field in told["constraint"].fields if field.name == "information")
    assert information.type == "repeated float"
