"""Wrong commands that users type: one line that names the remedy, and the remedy works."""

import gzip
import shlex
import shutil
import socket
import zipfile

import cv2
import numpy as np
import pytest

from fcslam.cli import main
from fcslam.runs import RobotTrajectory, Run
from tests.robot.fake_cloud import FakeCloud
from tests.robot.http_cloud import serving
from tests.sources import bag_messages, carmen_text
from tests.test_docs import complaint

pytestmark = pytest.mark.slow

MAP, PLAY = "map r.log -o out", "play r.log --server {url} --state state"
WRONG = [
    # The command, what its line says, and what its user types next.
    # Recordings
    ("map", "no recording is given", "map r.log"),
    ("map nowhere.bag", "nowhere.bag: no such file; check the path of the recording", ""),
    ("map anna=nowhere.bag", "nowhere.bag: no such file", ""),
    ("map =r.log", "=r.log: no such file", "map r.log"),
    ("map pic.png", "pic.png: not a recording of a known format; give a CARMEN log or ROS bag", "map r.bag"),
    ("map run/map.yaml", "run/map.yaml: not a recording of a known format", ""),
    ("map run", "run: is a run, not a recording; `fcslam map --onto run` continues it", "map --onto run"),
    ("map run/mission.fcslam", "is a run, not a recording; `fcslam map --onto run` continues it", "map --onto run"),
    ("info run/", "run/: is a run, not a recording", "map --onto run/"),
    ("map r.zip", "r.zip: is a zip archive; unpack it", "map r.log"),
    ("map empty", "empty: is a folder, not a recording; give the file of a recording", "map r.log"),
    ("map bags", "so they are not parts of one drive; give each as a recording", "map a=bags/a.bag b=bags/b.bag"),
    ("map empty.clf", "empty.clf: the file is empty", ""),
    ("map cut.clf.gz", "truncated", ""),
    ("map no_scans.bag", "no laser scans (sensor_msgs/LaserScan)", ""),
    ("map no_tf.bag", "give it with --sensors laser-pose=X,Y,THETA", "map no_tf.bag --sensors laser-pose=0,0,0"),
    ("map ros2:/r", "`fcslam robot ros2:/r` maps it", ""),
    ("info ros2:/r", "is a live robot, not a recording; `fcslam robot ros2:/r` maps it", ""),
    ("robot r.bag", "`fcslam play` plays a recording to a service", ""),
    ("robot ros2:r", "give one as in ros2:/robot1", ""),
    ("record ros2:/r -o day.bag", "a recording of a live robot is a .mcap file", ""),
    ("record r.log -o a.zip", "fcslam: a.zip: not a kind of bag; end it in .bag", "record r.log -o a.bag"),
    ("record r.log -o r.bag", "r.bag: exists; choose another name or give --force", "record r.log -o r.bag --force"),
    ("record r.log -o bags --force", "bags: is a folder, not a recording", ""),
    ("record r.log -o dir.bag --force", "dir.bag: is a folder, not a recording", ""),
    ("record r.log -o r.bag/a.mcap", "r.bag/a.mcap: cannot be written", ""),
    ("info r.bag --json --calibrate", "--json has no calibration", "info r.bag --calibrate"),
    # Robots
    ("map r.log r.bag", "two recordings are called 'r'", "map r.log b=r.bag"),
    ("map r.bag copy=r.bag", "so they are copies", "map r.bag"),
    ("map 'my robot=r.log'", "'my robot' is not a name (1-64 of A-Z a-z 0-9", "map my_robot=r.log"),
    ("map r+1=r.log", "'r+1' is the name of a session of 'r'; name it without '+1'", "map r=r.log"),
    ("map r.bag:/anna", "r.bag: has no robot /anna, it has /; choose one", "map r.bag:/"),
    ("map r.log --start anna=0,0,0", "a start names 'anna', but the robots are r", "map r.log --start r=0,0,0"),
    ("map r.log --start r=1,2", "'1,2' is not a pose; give X,Y,THETA", "map r.log --start r=1,2,0"),
    ("map r.log --start r", "--start r= '' is not a pose", ""),
    ("map r.log --start r=0,0,0 --start r=1,0,0", "two starts", ""),
    ("map r.log --floor x=1", "a floor names 'x', but the robots are r", "map r.log --floor r=1"),
    ("map r.log --floor 1 --floor 2", "all recordings can be on one floor only", ""),
    ("map r.log --floor r=1 --floor r=2", "r can be on one floor only", ""),
    ("map r.log --floor r=", "floor '' is not 1 to 16 of", ""),
    ("map r.log --floor r@1=1 --floor r@1=2", "r@1 can be on one floor only", ""),
    ("map r.log --floor r@soon=1", "expected NAME@TIME with seconds after the first scan", "map r.log --floor r@1=1"),
    ("map r.log --floor r@0=1", "expected NAME@TIME", ""),
    ("map r.log --floor r@1e9=1", "a floor begins 1e+09 s after the first scan, but r has", ""),
    ("map r.log --floor 'a\x1b[2J'", "is not 1 to 16 of", ""),
    ("map r.log --split 41", "cannot be cut into 41 parts; choose 1 to 40", "map r.log --split 2"),
    ("map r.log b=r.bag --split 2", "--split cuts one recording", "map r.log --split 2"),
    # Topics
    ("map r.bag --sensors scan-topic=/scans", "topic /scans is not there", "map r.bag --sensors scan-topic=/scan"),
    ("map r.bag --sensors odom-topic=/wheel", "the topics are /odom (nav", "map r.bag --sensors odom-topic=/odom"),
    ("map r.bag --sensors scan=/scan", "expected KEY=VALUE with a key of scan-topic, odom-topic", ""),
    ("map r.bag --sensors laser-pose=0.1,0", "is not a pose; give X,Y,THETA in metres and radians", ""),
    ("map r.bag --sensors scan-topic=", "expected KEY=VALUE", ""),
    ("map r.bag --sensors odom-topic=/odom --sensors odom-topic=none", "--sensors odom-topic: is given twice", ""),
    ("map r.bag --sensors laser-pose=nan,0,0", "is not a pose; give X,Y,THETA in metres", ""),
    ("map r.bag --sensors cloud-band=0.6,0.1", "--sensors cloud-band=0.6,0.1: is not a band of heights", ""),
    ("map r.bag --sensors cloud-band=0.1,0.6,-1", "is not a band of heights", ""),
    ("map r.log --sensors scan-topic=/scan", "go with ROS bags only, leave them out", "map r.log"),
    # Settings
    (f"{MAP} -c robot.lidar.resolution=0.1", "did you mean 'map.resolution_m'?", f"{MAP} -c map.resolution_m=0.1"),
    (f"{MAP} -c fleet.join_map=false", "did you mean 'fleet.join_maps'?", f"{MAP} -c fleet.join_maps=false"),
    (f"{MAP} -c fleet.join_maps=perhaps", "fleet.join_maps: Input should be a valid boolean", ""),
    (f"{MAP} -c map.resolution_m=5cm", "map.resolution_m: Input should be a valid number", ""),
    (f"{MAP} -c seed=-1", "--config: seed: Input should be greater than or equal to 0", ""),
    (f"{MAP} -c fleet.join_maps=[", "--config fleet.join_maps: not valid YAML", ""),
    (f"{MAP} -c fleet.start_sigma=[0.3]", "fleet.start_sigma.1: Field required", ""),
    (f"{MAP} -c seed", "seed: cannot read the configuration", f"{MAP} -c seed=1"),
    (f"{MAP} -c papr", "give FILE, KEY=VALUE or `paper`", f"{MAP} -c paper"),
    (f"{MAP} -c pic.png", "pic.png: cannot read the configuration", ""),
    (f"{MAP} -c notes.txt", "`fcslam tools config` prints a complete one", "tools config"),
    ("serve --data data --port 0 -c fleet.join_map=false", "did you mean 'fleet.join_maps'?", ""),
    # Missions, plans and tags
    ("map r.log --onto nowhere", "nowhere: no such file; `fcslam map` writes mission.fcslam into each run", ""),
    ("map run --onto r.bag", "run: is a run, not a recording", "map r.bag --onto run"),
    ("map r.bag --onto pic.png", "pic.png: not a mission file", "map r.bag --onto run"),
    ("map r.log --onto run", "r+1 and r of the earlier mission have the same scans at", "map r.bag --onto run"),
    ("map b=r.log --onto run", "b and r of the earlier mission have the same scans at", "map r.bag --onto run"),
    ("map r.log --plan plan.png", "give metres per pixel, as in --plan-scale 0.02", ""),
    ("map r.log --plan r.log", "r.log: cannot be read as a picture; save the plan as PNG", ""),
    ("map r.log --plan nowhere.png", "nowhere.png: cannot be read (No such file or directory); give", ""),
    ("map r.log --plan-scale 0.02", "belongs to --plan; name the plan, or leave the scale out", "map r.log"),
    ("map r.log --tags nowhere.yaml", "nowhere.yaml: cannot be read", ""),
    ("map r.log --tags pic.png", "give a YAML file of surveyed tags", ""),
    # Output
    ("map r.log -o run", "run: already holds a run; name a new folder or give --force", "map r.log -o run --force"),
    ("map r.log -o notes.txt", "notes.txt: exists and does not hold a run; name a new folder", ""),
    ("map r.log -o notes.txt/run", "notes.txt/run: cannot be used as the output folder", ""),
    ("show run --html run", "run: exists; name a new file", "show run --html report.html"),
    ("show run --html no/report.html", "cannot be written (No such file or directory: 'no/", ""),
    # Runs
    ("show nowhere", "nowhere: no such folder; check the path of the run", ""),
    ("show r.log", "not a run folder (it has no robots.csv or no trajectories/); `fcslam map` makes one", ""),
    ("evaluate quality pic.png", "pic.png: not a run folder", "evaluate quality run"),
    ("evaluate fleet run", "name the folder that has it with --truth", ""),
    ("evaluate fleet run --truth nowhere", "nowhere: no folder with the truth", ""),
    ("evaluate relations nowhere relations", "nowhere: no such folder", "evaluate relations two relations"),
    ("evaluate relations two nowhere", "nowhere: cannot read the relations", ""),
    ("evaluate relations two two", "cannot read the relations", ""),
    ("evaluate relations two relations --parts nowhere", "nowhere: no such folder", ""),
    ("evaluate relations two relations --csv no/t.csv", "cannot be written", ""),
    ("edit remove run nobody", "there is no session 'nobody'; there are r", "edit remove run r"),
    ("edit remove r run", "r: no such file", "edit remove run r"),
    ("edit undo run 3", "there is no edit 3; `fcslam edit list` shows all 0", "edit list run"),
    ("tools changes run --since yesterday", "neither a session of this map, a stamp in seconds nor a date such as", ""),
    ("localize r.log --map pic.png -o out", "give a run folder or the YAML file of a map", ""),
    ("localize r.log --map nowhere -o out", "nowhere: cannot be read as a map", "localize r.log --map run -o out"),
    ("localize run --map r.log -o out", "give a run folder", "localize r.log --map run -o out"),
    ("localize r.log --map run -o out --initial-pose 1,2", "is not a pose; give X,Y,THETA", ""),
    ("localize ros2:/r --map no --initial-pose 1,2", "--initial-pose '1,2' is not a pose", ""),
    ("localize ros2:/r --map no --update", "record the drive, and localize the recording", ""),
    ("localize ros2:/r --map no --server http://127.0.0.1:9", "no holds no earlier copy", ""),
    ("localize ros2:/r --map no --server cloud", "'cloud' is not the address of a cloud", ""),
    # Services
    ("play r.log --state state", "give --server, or map it here with `fcslam map`", "map r.log"),
    ("play ros2:/r --server {url} --state state", "`fcslam robot ros2:/r` maps it", ""),
    ("play r.log --server {host} --state state", "on this machine http://127.0.0.1:8340", PLAY),
    ("play r.log --server cloud --state state", "'cloud' is not the address of a cloud; give one like https://", ""),
    ("play r.log --server http://127.0.0.1:http --state state", "is not the address of a cloud", PLAY),
    ("play r.log --server http://me:secret@{host} --state state", "has no user name and no password; remove all", PLAY),
    (f"{PLAY} --credentials nowhere", "holds no credentials (token, ca.pem, client.pem and client.key)", PLAY),
    (f"{PLAY} --credentials words", "words/token: holds no token", PLAY),
    (f"{PLAY} --credentials half", "client.pem and client.key belong together", PLAY),
    (f"{PLAY} --credentials no_ca", "cannot read a certificate authority", PLAY),
    (
        "play r.log --state state --server https://localhost --credentials bad",
        "cannot read the certificate and its",
        "",
    ),
    ("play r.log --server {url} --state notes.txt", "notes.txt: cannot be made (File exists); give another", PLAY),
    ("play r+1=r.log --server {url} --state state", "name it without '+1'", PLAY),
    ("serve --data run --port 0", "run: is a run, which `fcslam show run` shows; name a folder for missions", ""),
    ("serve --data notes.txt --port 0", "notes.txt: cannot keep missions there", ""),
    ("serve --data data --host 0.0.0.0", "give --credentials, or --insecure", ""),
    ("serve --data data --credentials empty", "`fcslam tools certificates` makes them", "tools certificates -o empty"),
    ("serve --data data --host ::", "--insecure", ""),
    ("serve --data data --host 256.1.1.1 --insecure", "256.1.1.1", ""),
    ("serve --data data --port {port}", "choose another --port or --host", ""),
    ("show run --port {port}", "choose another --port or --host", ""),
    # Simulation
    *(
        (f"tools simulate --building flat --no-camera {option} -o sim", says, "")
        for option, says in (
            ("--robots 0", "0 is not in the range"),
            ("--robots 60", "too small for 60 robots"),
            ("--building castle", "castle"),
            ("--lighting dusk", "dusk"),
            ("--path-length 0", "0.0 is not in the range"),
            ("--path-length nan", "nan: is not a finite number"),
            ("--path-length=-inf", "inf: is not a finite number"),
        )
    ),
    # Names that no file can have
    *(
        (f"{command} {{long}} {more}", "xxx", "")
        for command, more in (
            ("show", ""),
            ("show run --html", ""),
            ("evaluate quality", ""),
            ("evaluate fleet", ""),
            ("map --onto", ""),
            ("edit list", ""),
            ("edit veto", "a b"),
            ("edit erase", "'0,0 1,1'"),
            ("localize r.log -o out --map", ""),
            ("tools changes", ""),
            ("tools extract", ""),
            ("serve --data", "--port 0"),
            ("map r.log -o", ""),
            ("info", ""),
            ("play r.log --server {url} --state", ""),
            ("record r.log -o", ""),
        )
    ),
    # Words
    ("mapp r.log", "No such command 'mapp'. Did you mean 'map'?", "map r.log"),
    ("help", "(`fcslam -h` shows what there is)", "-h"),
    ("--nonsense", "No such option: --nonsense", "-h"),
    ("evaluate relations two", "Missing argument", "evaluate relations -h"),
    ("map r.log --output", "'--output' requires an argument", MAP),
    ("map r.log --split two", "'two' is not a valid integer range (`fcslam map -h`", "map -h"),
]


@pytest.fixture(scope="module")
def artifacts(tmp_path_factory):
    """One of everything that users have."""
    place = tmp_path_factory.mktemp("artifacts")
    for name in ("bags", "empty", "dir.bag"):
        (place / name).mkdir()
    carmen_text.save(place / "r.log", carmen_text.drive(40))
    said = bag_messages.drive(40)
    bag_messages.save(place / "r.bag", said)
    for name, later_s in (("a", 0.0), ("b", 0.02)):
        bag_messages.save(place / "bags" / f"{name}.bag", bag_messages.drive(40, 100.0 + later_s))
    bag_messages.save(place / "no_scans.bag", [one for one in said if one.topic != "/scan"])
    bag_messages.save(place / "no_tf.bag", said[1:])
    assert main(["map", str(place / "r.log"), "-o", str(place / "run"), "-q"]) == 0
    stands = {f"r{k}": RobotTrajectory(f"r{k}", 0, np.array([100.0 * k]), np.array([[k, 0.0, 0.0]])) for k in (0, 1)}
    Run(stands).save(place / "two")
    (place / "relations").write_text("0 100 1.25 0 0 0 0 0\n0 999 0 0 0 0 0 0\n")
    (place / "notes.txt").write_text("hello\n")
    for name in ("words/token", "half/client.pem", "no_ca/ca.pem", "bad/client.pem", "bad/client.key"):
        (place / name).parent.mkdir(exist_ok=True)
        (place / name).write_text("two words\n")
    (place / "empty.clf").touch()
    (place / "cut.clf.gz").write_bytes(gzip.compress("\n".join(carmen_text.drive(500)).encode())[:-200])
    for name in ("pic.png", "plan.png"):
        cv2.imwrite(str(place / name), np.full((50, 60), 255, np.uint8))
    with zipfile.ZipFile(place / "r.zip", "w") as archive:
        archive.write(place / "r.log", "r.log")
    return place


def times_of(place):
    """What is there, beside what a robot keeps for its next try."""
    return {path: path.stat().st_mtime_ns for path in place.rglob("*") if path.is_file() and "state" not in path.parts}


@pytest.mark.parametrize(("command", "says", "remedy"), WRONG, ids=[command for command, *_ in WRONG])
def test_a_wrong_command_is_one_line_whose_remedy_works(
    artifacts, tmp_path, monkeypatch, refused, capsys, command, says, remedy
):
    place = shutil.copytree(artifacts, tmp_path / "place")
    monkeypatch.chdir(place)
    before = times_of(place)
    with serving(FakeCloud(correction=4)) as cloud, socket.create_server(("127.0.0.1", 0)) as taken:
        names = {"url": cloud.url, "host": cloud.url.removeprefix("http://"), "port": taken.getsockname()[1]}
        names["long"] = 300 * "x"
        line = refused(*shlex.split(command.format(**names)))
        assert says in line
        named = [words for words in line.split("`")[1::2] if words.startswith("fcslam ") and not words.endswith(" -h")]
        assert not any(complaint(words, complete=False) for words in named)
        assert times_of(place) == before
        if remedy:
            assert main(shlex.split(remedy.format(**names))) == 0, capsys.readouterr().err
