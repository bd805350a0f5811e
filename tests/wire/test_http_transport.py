"""HTTP one request at a time: what goes over the wire, and what each answer means."""

import gzip
import json
from datetime import UTC, datetime, timedelta

import pytest

from fcslam.errors import CloudError, OversizeError, UnavailableError
from fcslam.records import Channel
from fcslam.service.credentials import make_credentials
from fcslam.wire.batches import AGENT_HEADER, CORRECTION_HEADER, MEDIA_TYPE, read_batch
from fcslam.wire.http_transport import HttpResponse, HttpTransport
from fcslam.wire.keys import Server
from fcslam.wire.messages import Acknowledgement
from fcslam.wire.packets import decode, encode
from tests.robot.fake_cloud import said
from tests.robot.http_cloud import serving
from tests.wire.examples import LIDAR_PLACE

pytestmark = pytest.mark.slow

PACKETS = [encode(said(0)), encode(said(1, LIDAR_PLACE))]


@pytest.fixture
def cloud():
    with serving() as cloud:
        yield cloud


@pytest.fixture
def transport(cloud):
    transport = HttpTransport(Server(cloud.url + "/", "secret"), "r 1+2", "ab" * 16)
    yield transport
    transport.close()


def error(status, text="no", **more):
    headers = {"Retry-After": str(more.pop("after"))} if "after" in more else {}
    return status, headers, json.dumps({"error": text, **more}).encode()


def test_a_batch_and_what_comes_back(cloud, transport):
    answer = transport.send(PACKETS, 7)
    assert [decode(data).body for data in answer.packets] == [Acknowledgement("alice", 0, 1)]
    ((method, path, headers, body),) = cloud.requests
    assert (method, path) == ("POST", "/api/v1/robots/r%201%2B2/packets")
    assert read_batch(body) == PACKETS
    told = {name: headers[name] for name in (AGENT_HEADER, CORRECTION_HEADER, "Content-Type", "Authorization")}
    assert told == {
        AGENT_HEADER: "ab" * 16, CORRECTION_HEADER: "7", "Content-Type": MEDIA_TYPE, "Authorization": "Bearer secret",
    }  # fmt: skip
    assert transport.state().expected == {0: 2}
    assert cloud.requests[-1][:2] == ("GET", "/api/v1/robots/r%201%2B2/state")


def test_what_the_cloud_refused_is_heard_of(cloud, transport):
    cloud.cloud.refused[0, 1] = "no such keyscan"
    assert transport.send(PACKETS[:1], -1).refused == 1
    assert transport.state().refused == {(0, 1): "no such keyscan"}


def test_a_refused_packet_is_told_by_its_place(cloud, transport):
    cloud.canned.append(error(400, "bad", index=1))
    assert transport.send(PACKETS, -1) == HttpResponse(refusal=(1, f"{cloud.url}: bad (400)"))


@pytest.mark.parametrize(
    ("status", "more", "wait_s"),
    [
        (400, {}, 0.0), (400, {"index": 2}, 0.0), (400, {"index": -1}, 0.0), (400, {"index": "1"}, 0.0),
        (409, {}, 0.0), (409, {"after": 12}, 12.0), (429, {"after": 3}, 3.0), (429, {}, 0.0), (500, {}, 0.0),
        (502, {}, 0.0), (503, {"after": "soon"}, 0.0), (507, {}, 0.0),
    ],
)  # fmt: skip
def test_what_may_succeed_later(cloud, transport, status, more, wait_s):
    cloud.canned.append(error(status, "why", **more))
    with pytest.raises(UnavailableError, match=rf"why \({status}\)") as caught:
        transport.send(PACKETS, -1)
    assert caught.value.retry_after_s == wait_s


@pytest.mark.parametrize(
    ("status", "more", "kind", "end"),
    [
        (401, {}, CloudError, ".* in --credentials$"), (403, {}, CloudError, ""), (404, {}, CloudError, ""),
        (409, {"index": 1}, CloudError, ""), (413, {}, OversizeError, ""), (302, {}, CloudError, ""),
    ],
)  # fmt: skip
def test_what_never_will(cloud, transport, status, more, kind, end):
    cloud.canned.append(error(status, "why", **more))
    with pytest.raises(kind, match=rf"why \({status}\){end}"):
        transport.send(PACKETS, -1)


def test_a_token_that_was_good_may_be_good_again(cloud, transport):
    transport.send(PACKETS[:1], -1)
    cloud.canned += [error(401, "unknown token"), error(403, "another robot's")]
    with pytest.raises(UnavailableError, match=r"unknown token \(401\)"):
        transport.state()
    with pytest.raises(CloudError, match=r"another robot's \(403\)") as caught:
        transport.state()
    assert not isinstance(caught.value, UnavailableError)


def test_answers_that_are_none(cloud, transport):
    cloud.canned += [(200, {}, b"noise"), (502, {}, b"<html>"), (404, {}, b"[]")]
    with pytest.raises(UnavailableError, match="the reply is broken"):
        transport.send(PACKETS, -1)
    with pytest.raises(UnavailableError, match=r"Bad Gateway \(502\)"):
        transport.send(PACKETS, -1)
    with pytest.raises(CloudError, match=r"Not Found \(404\)"):
        transport.send(PACKETS, -1)


@pytest.mark.parametrize(
    "body", [b"<html>", b"[]", b"{}", b'{"next": {}}', b'{"next": {"a": 1}, "refused": []}', b'{"next": [1]}']
)
def test_another_server_is_no_cloud(cloud, transport, body):
    cloud.canned.append((200, {}, body))
    with pytest.raises(CloudError, match="does not come from an fcslam cloud"):
        transport.state()


@pytest.mark.parametrize("packed", [False, True])
def test_a_reply_without_an_end_is_read_no_further_than_the_limit(cloud, transport, packed):
    transport.most_reply_bytes = 1000
    for size in (1000, 1001):
        answer = ({"Content-Encoding": "gzip"}, gzip.compress(bytes(size))) if packed else ({}, bytes(size))
        cloud.canned.append((200, *answer))
    assert transport.detector(Channel.CAMERA, "v1") == bytes(1000)
    with pytest.raises(CloudError, match="over 1000 bytes"):
        transport.detector(Channel.CAMERA, "v1")


def test_where_an_instance_does_not_answer_the_next_one_is_asked_and_stays(cloud):
    instances = HttpTransport(Server(f"http://127.0.0.1:9, {cloud.url}"), "r", "ab" * 16)
    with pytest.raises(UnavailableError, match=r"127\.0\.0\.1:9"):
        instances.state()  # the caller waits before it tries again
    instances.send(PACKETS, -1)
    assert instances.state().expected == {0: 2}
    cloud.canned.append(error(503))
    with pytest.raises(UnavailableError, match="503"):
        instances.state()
    with pytest.raises(UnavailableError, match=r"127\.0\.0\.1:9"):
        instances.state()
    assert instances.state().expected == {0: 2}
    instances.close()


def test_a_network_comes_as_it_is(cloud, transport):
    cloud.canned.append((200, {}, b"onnx"))
    assert transport.detector(Channel.CAMERA, "cnn-0.3+r12") == b"onnx"
    assert cloud.requests[0][:2] == ("GET", "/api/v1/detectors/camera/cnn-0.3%2Br12")


@pytest.mark.parametrize(
    "url",
    [
        "cloud.example", "ftp://cloud.example", "https://", "8443", "", "http://localhost:x", "http://localhost:99999",
        "http://localhost:-5", "http://localhost:0", "http://[::1", "http://a b:80",
    ],
)  # fmt: skip
def test_an_address_must_be_one(url):
    with pytest.raises(CloudError, match="not the address of a cloud"):
        HttpTransport(Server(url), "r", "ab" * 16)


def test_a_token_is_not_shown_to_the_network():
    with pytest.raises(CloudError, match="use https"):
        HttpTransport(Server("http://cloud.example", "secret"), "r", "ab" * 16)
    for url in ("http://localhost:80", "http://[::1]:80", "https://cloud.example"):
        HttpTransport(Server(url, "secret"), "r", "ab" * 16).close()
    HttpTransport(Server("http://cloud.example"), "r", "ab" * 16).close()


def test_a_certificate_is_asked_for_and_must_be_signed_by_whom_is_trusted(tmp_path):
    ours, others = tmp_path / "ours", tmp_path / "others"
    for folder in (ours, others):
        make_credentials(folder, ["127.0.0.1"], {}, datetime.now(UTC))
    with serving(tls=ours) as cloud:
        trusting = HttpTransport(Server(cloud.url, "secret", ours / "ca.pem"), "r", "ab" * 16)
        assert len(trusting.send(PACKETS, -1).packets) == 1
        trusting.close()
        for ca in (None, others / "ca.pem"):
            wary = HttpTransport(Server(cloud.url, "secret", ca), "r", "ab" * 16)
            with pytest.raises(CloudError, match="its certificate is not trusted"):
                wary.send(PACKETS, -1)
            wary.close()
        plain = HttpTransport(Server(cloud.url.replace("https", "http")), "r", "ab" * 16)
        with pytest.raises(UnavailableError, match="its address begins with https://"):
            plain.send(PACKETS, -1)
        plain.close()
    assert len(cloud.requests) == 1, "no token went to a stranger"


@pytest.mark.parametrize(
    ("host", "days", "said"),
    [
        ("127.1", 0, "is not valid for '127.1'.*ask the cloud by a name of its certificate"),
        ("127.0.0.1", -400, "has expired.*renew it"),
        ("127.0.0.1", 30, "is not yet valid.*correct the clock"),
    ],
)
def test_a_certificate_of_another_name_or_date_gets_no_packet_and_no_token(host, days, said, tmp_path):
    make_credentials(tmp_path, [], {}, datetime.now(UTC) + timedelta(days))
    with serving(tls=tmp_path) as cloud:
        url = cloud.url.replace("127.0.0.1", host)
        wary = HttpTransport(Server(url, "secret", tmp_path / "ca.pem"), "r", "ab" * 16)
        with pytest.raises(CloudError, match=said):
            wary.send(PACKETS, -1)
        wary.close()
    assert cloud.requests == []


def test_a_cloud_without_tls_is_named(cloud):
    secure = HttpTransport(Server(cloud.url.replace("http", "https")), "r", "ab" * 16)
    with pytest.raises(UnavailableError, match="its address begins with http://"):
        secure.send(PACKETS, -1)
    secure.close()


@pytest.mark.parametrize("content", [None, b"noise"])
def test_an_authority_must_be_readable(tmp_path, content):
    if content is not None:
        (tmp_path / "ca.pem").write_bytes(content)
    with pytest.raises(CloudError, match="give a PEM file"):
        HttpTransport(Server("https://cloud.example", ca=tmp_path / "ca.pem"), "r", "ab" * 16)
