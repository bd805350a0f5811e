"""The page of what leaves a robot explains every field of the schema, and none that it does not have."""

import re
from pathlib import Path

from fcslam.wire import fcslam_pb2 as pb

PAGE = Path(__file__).parents[2] / "docs" / "concepts" / "what-leaves.md"
PLAIN = {"Pose", "SpacePose"}
"""Messages without a meaning of their own besides the field that holds them."""
FROM_CLOUD = {"Correction", "DetectorUpdate", "Acknowledgement"}


def test_the_page_says_what_each_field_could_reveal():
    rows = re.findall(r"^\| `(\w+)` \| (`[^|]+`) \| .+ \|$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    told = [(message, field) for message, fields in rows for field in re.findall(r"`(\w+)`", fields)]
    known = pb.DESCRIPTOR.message_types_by_name
    messages = [known[name] for name in known if name not in PLAIN | FROM_CLOUD]
    fields = [(m.name, f.name) for m in messages for f in m.fields if f.containing_oneof is None]
    assert sorted(told) == sorted(fields)
