"""How Unitree's SDK is called, and what becomes of what it says, with a stand-in for it."""

import sys
from types import SimpleNamespace

import pytest

from legged.deploy import unitree
from legged.deploy.unitree import KINDS, SdkWire
from legged.errors import ConfigError, RunError


class Sdk:
    """What is imported of the SDK; it keeps what it was `told`."""

    def __init__(self, monkeypatch, modes=(), joins=True):
        self.told, self.modes, self.joins, self.sends = [], list(modes), joins, True
        now, sdk = [0.0], self

        class Client:
            def SetTimeout(self, seconds):  # noqa: N802  (names of the SDK)
                sdk.told.append(("timeout", seconds))

            def Init(self):  # noqa: N802
                sdk.told.append("client")

            def CheckMode(self):  # noqa: N802
                return sdk.modes.pop(0) if len(sdk.modes) > 1 else sdk.modes[0]

            def ReleaseMode(self):  # noqa: N802
                sdk.told.append("release")

        class Channel:
            def __init__(self, topic, kind):
                sdk.told.append((topic, kind))

            def Init(self, *handler):  # noqa: N802
                sdk.told.append(("init", *handler))

            def Write(self, command):  # noqa: N802
                sdk.told.append(("write", command))
                return sdk.sends

            def Close(self):  # noqa: N802
                sdk.told.append("close")

        modules = {
            "unitree_sdk2py.core.channel": {
                "ChannelFactoryInitialize": self.initialise,
                "ChannelPublisher": Channel,
                "ChannelSubscriber": Channel,
            },
            "unitree_sdk2py.idl.default": {"unitree_hg_msg_dds__LowCmd_": lambda: "zeros"},
            "unitree_sdk2py.idl.unitree_hg.msg.dds_": {"LowCmd_": "LowCmd", "LowState_": "LowState"},
            "unitree_sdk2py.comm.motion_switcher.motion_switcher_client": {"MotionSwitcherClient": Client},
        }
        found = {name: SimpleNamespace(**members) for name, members in modules.items()}

        def sleep(seconds):
            now[0] += seconds

        monkeypatch.setattr(unitree, "import_module", found.__getitem__)
        monkeypatch.setattr(unitree, "time", SimpleNamespace(sleep=sleep, perf_counter=lambda: now[0]))

    def initialise(self, domain, network):
        if not self.joins:
            raise Exception("channel factory init error.")
        self.told.append((domain, network))


def test_without_the_sdk_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "unitree_sdk2py", None)
    with pytest.raises(ConfigError, match=r"SDK cannot be imported \(.*\); run `pip install 'legged\[unitree-sdk2\]'`"):
        SdkWire(KINDS["go2"], "lo", 1)


def test_the_wire_calls_the_sdk_as_it_wants_to_be_called(monkeypatch):
    """Topics, messages, network and domain; and a robot that walks by itself is told to leave that once it is known."""
    sdk = Sdk(monkeypatch, [(0, {"name": "mcf"}), (0, {"name": ""})])
    wire = SdkWire(KINDS["g1"], "eth0", 0)
    assert wire.new_command() == "zeros"
    wire.listen(print)
    wire.take_over()
    wire.send("command")
    wire.close()
    assert sdk.told == [
        (0, "eth0"),
        ("rt/lowcmd", "LowCmd"),
        ("init",),
        ("rt/lowstate", "LowState"),
        ("init", print, 10),
        ("timeout", unitree.RELEASE_S),
        "client",
        "release",
        ("write", "command"),
        "close",
        "close",
    ]


def test_unitrees_simulator_has_no_controller_that_must_be_left(monkeypatch):
    """It serves low-level messages alone: whoever waits for an answer about a controller never gets one."""
    sdk = Sdk(monkeypatch, [(3104, None)])
    SdkWire(KINDS["g1"], "lo", 1).take_over()
    assert sdk.told == [(1, "lo"), ("rt/lowcmd", "LowCmd"), ("init",), ("rt/lowstate", "LowState")]


@pytest.mark.parametrize(
    ("mode", "says"),
    [
        ((3104, None), "the robot does not say if its own controller is on; check --network"),
        ((0, {"name": "mcf"}), "the robot's own controller is still on after 10 s; switch it off by hand"),
    ],
)
def test_a_robot_that_does_not_answer_is_not_said_to_keep_its_controller(monkeypatch, mode, says):
    Sdk(monkeypatch, [mode])
    wire = SdkWire(KINDS["g1"], "eth0", 0)
    with pytest.raises(RunError, match=says):
        wire.take_over()


def test_an_sdk_that_cannot_switch_controllers_is_refused_at_once(monkeypatch):
    """Release 1.0.1 lacks `comm`; a simulator does without."""
    Sdk(monkeypatch)
    found = unitree.import_module

    def without(name):
        if name == unitree.SWITCHER:
            raise ImportError(f"No module named '{name}'")
        return found(name)

    monkeypatch.setattr(unitree, "import_module", without)
    with pytest.raises(ConfigError, match=r"SDK cannot be imported \(No module named .*motion_switcher.*\); run `pip"):
        SdkWire(KINDS["g1"], "eth0", 0)
    SdkWire(KINDS["g1"], "lo", 1).take_over()


def test_a_network_that_is_not_there_is_named(monkeypatch):
    Sdk(monkeypatch, joins=False)
    with pytest.raises(ConfigError, match=r"^--network: eth7: domain 0 cannot be joined \(channel factory init error"):
        SdkWire(KINDS["g1"], "eth7", 0)


def test_a_command_that_the_sdk_could_not_send_is_no_command(monkeypatch):
    """The SDK says so by what it returns; of a program that did not notice, the robot would keep the last command."""
    sdk = Sdk(monkeypatch)
    wire = SdkWire(KINDS["g1"], "eth0", 0)
    sdk.sends = False
    with pytest.raises(RunError, match="could not send a command"):
        wire.send("command")
