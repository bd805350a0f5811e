"""Messages of federated rounds: what a robot refuses."""

import pytest

from fcslam.errors import InputError
from fcslam.learning.federated.messages import read_request


@pytest.mark.parametrize("header", [b"null", b"[]", b'"x"', b"{}", b'{"arrays": []}'])
def test_a_request_whose_header_is_no_mapping_is_refused(header):
    with pytest.raises(InputError, match="cannot be read"):
        read_request(len(header).to_bytes(4, "little") + header)
