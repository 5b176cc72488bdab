"""The door for pages, gateways, bridges and commands: join a run, start one, or stand in for one side of it.

A page connects as a client and reads the packets; a bridge or a replay serves packets and answers requests; a
command speaks as `afspm` does. Nothing is defined here: each name is imported from its module when it is first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from afspm.basics.lazy import lazily

if TYPE_CHECKING:
    from afspm.cli.arguments import AFTERWARDS, MEANWHILE, RUNS, NoProgress, Where, names_in, opt
    from afspm.cli.joining import looking, plain_console, plain_table
    from afspm.client.experiment_link import ExperimentLink
    from afspm.experiment.class_loader import importing_from
    from afspm.experiment.experiment import Experiment, load_expanded
    from afspm.experiment.toml_writer import dumps as toml_text
    from afspm.supervisor.ports import FreePorts
    from afspm.supervisor.run import RunOptions
    from afspm.supervisor.run import run as run_experiment
    from afspm.transport.late_joiners import PublishedHistory
    from afspm.transport.network import Network
    from afspm.transport.polling import Poller, WakeUp
    from afspm.transport.port import ControlConnected, Incoming, Killed, PacketReceived, ParentGone, ReplyReceived
    from afspm.transport.process.context import ProcessActivity, ProcessContext, new_session
    from afspm.transport.process.parent import StopRequested
    from afspm.transport.rate_limited_log import RateLimitedLog
    from afspm.transport.router import PeerAsked, Router
    from afspm.transport.zmq_port import open_port

if TYPE_CHECKING:  # a page offers an ended run for resuming, reads its log, and has a name of its own
    from afspm.experiment.process_starts import DASHBOARD
    from afspm.storage.packet_log import log_folder, logged_packets
    from afspm.supervisor.resume import ResumableRun

if TYPE_CHECKING:  # a bridge or a replay speaks for one side: its sockets, and the events of the other
    from afspm.transport.control_client import ControlClient
    from afspm.transport.frames import receive_frames, send_frames, send_packet
    from afspm.transport.network import ACCEPTED, CONNECTED, DISCONNECTED, MAX_PACKET_BYTES, Monitor, is_local
    from afspm.transport.polling import milliseconds
    from afspm.transport.port import RequestReceived, Served, SubscriberJoined
    from afspm.transport.publisher import Publisher
    from afspm.transport.router import PeerConnected, PeerDisconnected, RouterEvent
    from afspm.transport.subscriber import Subscriber
    from afspm.transport.zmq_port import BasePort
    from afspm.transport.zmq_server import ZmqServerPort

if TYPE_CHECKING:  # one command, page or bridge has it, and another may
    from afspm.cli.arguments import HelpWhenBare, RecordedRun
    from afspm.cli.declared_commands import DeclaredCommands
    from afspm.experiment.experiment import load as load_experiment
    from afspm.supervisor.own_runs import register_own_messages
    from afspm.supervisor.run import dry_run
    from afspm.supervisor.run import now as run_time
    from afspm.transport.port import Port
    from afspm.transport.process.context import step_back
    from afspm.transport.process.loading import find_object
    from afspm.transport.process.parent import leave_interrupts_to_parent
    from afspm.transport.zmq_port import ZmqPort

__all__ = [
    "ACCEPTED",
    "AFTERWARDS",
    "CONNECTED",
    "DASHBOARD",
    "DISCONNECTED",
    "MAX_PACKET_BYTES",
    "MEANWHILE",
    "RUNS",
    "BasePort",
    "ControlClient",
    "ControlConnected",
    "DeclaredCommands",
    "Experiment",
    "ExperimentLink",
    "FreePorts",
    "HelpWhenBare",
    "Incoming",
    "Killed",
    "Monitor",
    "Network",
    "NoProgress",
    "PacketReceived",
    "ParentGone",
    "PeerAsked",
    "PeerConnected",
    "PeerDisconnected",
    "Poller",
    "Port",
    "ProcessActivity",
    "ProcessContext",
    "PublishedHistory",
    "Publisher",
    "RateLimitedLog",
    "RecordedRun",
    "ReplyReceived",
    "RequestReceived",
    "ResumableRun",
    "Router",
    "RouterEvent",
    "RunOptions",
    "Served",
    "StopRequested",
    "Subscriber",
    "SubscriberJoined",
    "WakeUp",
    "Where",
    "ZmqPort",
    "ZmqServerPort",
    "dry_run",
    "find_object",
    "importing_from",
    "is_local",
    "leave_interrupts_to_parent",
    "load_expanded",
    "load_experiment",
    "log_folder",
    "logged_packets",
    "looking",
    "milliseconds",
    "names_in",
    "new_session",
    "open_port",
    "opt",
    "plain_console",
    "plain_table",
    "receive_frames",
    "register_own_messages",
    "run_experiment",
    "run_time",
    "send_frames",
    "send_packet",
    "step_back",
    "toml_text",
]

if not TYPE_CHECKING:
    __getattr__ = lazily(
        __name__,
        {
            "afspm.cli.arguments": "AFTERWARDS MEANWHILE RUNS NoProgress Where names_in opt HelpWhenBare RecordedRun",
            "afspm.cli.declared_commands": "DeclaredCommands",
            "afspm.cli.joining": "looking plain_console plain_table",
            "afspm.client.experiment_link": "ExperimentLink",
            "afspm.experiment.class_loader": "importing_from",
            "afspm.experiment.experiment": "Experiment load_expanded",
            "afspm.experiment.process_starts": "DASHBOARD",
            "afspm.storage.packet_log": "log_folder logged_packets",
            "afspm.supervisor.own_runs": "register_own_messages",
            "afspm.supervisor.ports": "FreePorts",
            "afspm.supervisor.resume": "ResumableRun",
            "afspm.supervisor.run": "RunOptions dry_run",
            "afspm.transport.control_client": "ControlClient",
            "afspm.transport.frames": "receive_frames send_frames send_packet",
            "afspm.transport.late_joiners": "PublishedHistory",
            "afspm.transport.network": "Network ACCEPTED CONNECTED DISCONNECTED MAX_PACKET_BYTES Monitor is_local",
            "afspm.transport.polling": "Poller WakeUp milliseconds",
            "afspm.transport.port": (
                "ControlConnected Incoming Killed PacketReceived ParentGone ReplyReceived RequestReceived "
                "Served SubscriberJoined Port"
            ),
            "afspm.transport.process.context": "ProcessActivity ProcessContext new_session step_back",
            "afspm.transport.process.loading": "find_object",
            "afspm.transport.process.parent": "StopRequested leave_interrupts_to_parent",
            "afspm.transport.publisher": "Publisher",
            "afspm.transport.rate_limited_log": "RateLimitedLog",
            "afspm.transport.router": "PeerAsked Router PeerConnected PeerDisconnected RouterEvent",
            "afspm.transport.subscriber": "Subscriber",
            "afspm.transport.zmq_port": "open_port BasePort ZmqPort",
            "afspm.transport.zmq_server": "ZmqServerPort",
        },
        load_experiment="afspm.experiment.experiment.load",
        run_experiment="afspm.supervisor.run.run",
        run_time="afspm.supervisor.run.now",
        toml_text="afspm.experiment.toml_writer.dumps",
    )
