"""The page of what leaves a robot explains every field of the schema, and none that it does not have."""

import re
from pathlib import Path

from fcslam.wire import fcslam_pb2 as pb

PAGE = Path(__file__).parents[2] / "docs" / "concepts" / "what-leaves.md"
PLAIN = {"Pose", "SpacePose"}
"""Messages without a meaning of their own besides the field that holds them."""


def test_the_page_says_what_each_field_could_reveal():
    told = re.findall(r"^\| `(\w+)` \| `(\w+)` \| .+ \|$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    messages = [message for name, message in pb.DESCRIPTOR.message_types_by_name.items() if name not in PLAIN]
    fields = [(m.name, f.name) for m in messages for f in m.fields if f.containing_oneof is None]
    assert sorted(told) == sorted(fields)
