"""A node of ROS 2 on Zenoh, written from the design document and the source of rmw_zenoh, and not from fcslam's bridge.

No real rmw_zenoh can be installed by pip. Hashes of types are those of the packages of ROS 2 Kilted.
"""

import struct
import time

import zenoh

HASHES = {
    "sensor_msgs/LaserScan": "RIHS01_64c191398013af96509d518dac71d5164f9382553fce5c1f8cca5be7924bd828",
    "nav_msgs/Odometry": "RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
    "nav_msgs/OccupancyGrid": "RIHS01_8d348150c12913a31ee0ec170fbf25089e4745d17035792a1ba94d6f0bc0cfc7",
    "geometry_msgs/PoseWithCovarianceStamped": (
        "RIHS01_26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e"
    ),
    "tf2_msgs/TFMessage": "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    "std_msgs/String": "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
}
RELIABLE, BEST_EFFORT, LATCHED = "::,10:,:,:,,", "2::,5:,:,:,,", ":1:,1:,:,:,,"


def router(port):
    return _session(mode='"router"', listen=f"tcp/127.0.0.1:{port}")


def _session(mode, listen, connect=""):
    config = zenoh.Config()
    config.insert_json5("mode", mode)
    config.insert_json5("listen/endpoints", f'["{listen}"]')
    config.insert_json5("connect/endpoints", f'["{connect}"]' if connect else "[]")
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("timestamping/enabled", "true")
    return zenoh.open(config)


def attached(number, sender):
    return struct.pack("<q", number) + struct.pack("<q", time.time_ns()) + b"\x10" + sender


class ZenohPeer:
    def __init__(self, port, domain=0):
        self.session = _session('"peer"', "tcp/127.0.0.1:0", f"tcp/127.0.0.1:{port}")
        self.domain, self.entities, self.tokens, self.seen = domain, 0, [], set()
        everything = f"@ros2_lv/{domain}/**"
        self.tokens.append(self.session.liveliness().declare_subscriber(everything, self._see, history=True))
        self._declare("NN")

    def _see(self, sample):
        is_there = sample.kind == zenoh.SampleKind.PUT
        (self.seen.add if is_there else self.seen.discard)(str(sample.key_expr))

    def _declare(self, entity, *words):
        number = f"0/{self.entities}"
        self.entities += 1
        token = "/".join(
            ("@ros2_lv", str(self.domain), str(self.session.zid()), number, entity, "%", "%", "driver", *words)
        )
        self.tokens.append(self.session.liveliness().declare_token(token))

    def _key(self, topic, kind):
        package, name = kind.split("/")
        return f"{self.domain}{topic}/{package}::msg::dds_::{name}_/{HASHES[kind]}"

    def publisher(self, topic, kind, quality):
        key = self._key(topic, kind)
        if quality == LATCHED:
            publisher = zenoh.ext.declare_advanced_publisher(
                self.session, key, cache=zenoh.ext.CacheConfig(1), publisher_detection=True,
                sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.5),
            )  # fmt: skip
        else:
            publisher = self.session.declare_publisher(key)
        self.tokens.append(publisher)
        self._declare("MP", topic.replace("/", "%"), *key.split("/")[-2:], quality)
        sender = str(self.session.zid()).encode().ljust(16)[:16]
        return lambda payload, number=1: publisher.put(payload, attachment=attached(number, sender))

    def subscribe(self, topic, kind, quality, take):
        key = self._key(topic, kind)

        def checked(sample):
            if len(sample.attachment.to_bytes()) != 33:  # rmw_zenoh drops a message without it
                return
            take(sample.payload.to_bytes())

        if quality == LATCHED:
            self.tokens.append(
                zenoh.ext.declare_advanced_subscriber(
                    self.session, key, checked, subscriber_detection=True,
                    history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
                    recovery=zenoh.ext.RecoveryConfig(heartbeat=True),
                )
            )  # fmt: skip
        else:
            self.tokens.append(self.session.declare_subscriber(key, checked))
        self._declare("MS", topic.replace("/", "%"), *key.split("/")[-2:], quality)

    def graph(self):
        """The entities of the domain as rmw_zenoh reads their tokens: 9 words of a node, 13 of an endpoint."""
        found = [token.split("/") for token in tuple(self.seen)]
        assert all(len(words) == (9 if words[5] == "NN" else 13) for words in found)
        return {tuple(words[5:]) for words in found}

    def close(self):
        self.session.close()
