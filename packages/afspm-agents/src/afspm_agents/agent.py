"""`Agent`: the component that offers the tools of an experiment to AI agents, over the Model Context Protocol."""

from __future__ import annotations

from afspm.model import Frame
from afspm.plugins.web.gateway.gateway import MOST_REQUESTS, Gateway
from afspm.plugins.web.watch import Bell
from afspm.record import experiment_name


class Agent(Gateway):
    """A server of thirteen tools at `/mcp`: agents look, propose plans, measure with a person's approval, and stop.

    An agent acts as `<component>:<name>`. The scheduler keeps its approvals and checks each of its requests; nothing
    in this process, or in the client of a model, can allow more. The component has the settings of the Gateway.
    """

    served = "agent server"
    usual_port = 8091
    requires = ("afspm-agents",)
    needs_approval = True

    def on_start(self) -> None:
        # imported here: a check of the file needs none of them
        from afspm.plugins.web.gateway.measurements import Measurements
        from afspm.plugins.web.persons import Persons
        from afspm_agents.preflight import Preflight
        from afspm_agents.serving import application
        from afspm_agents.tools import AgentTools
        from afspm_agents.workplace import Workplace

        launch = self._context.launch
        bound = self.open_port()
        archive, watch = self.watch_run()
        self._watch = watch
        bell = Bell()
        watch.on_change(bell.ring)
        self._persons = Persons(launch, self.clock, watch)
        self._place = Workplace(
            watch, bell, archive, Measurements(self.state_file("measurements.json"), watch, self.clock.monotonic_s),
            self._persons, Frame.SAMPLE if launch.sample_coordinates else Frame.TIP,
            experiment=experiment_name(self.run_dir, "afspm"), simulated=self.simulated, run_dir=self.run_dir,
            file=self.state_file("runs.json"),
        )  # fmt: skip
        tools = AgentTools(self._place, Preflight())
        app = application(tools, self._passwords, host=self._host, origins=self._origins)
        self.serve(app, bound, most_requests=MOST_REQUESTS)

    def on_message(self, envelope: str, message: object) -> None:
        time_ns = self.packet_time_ns()
        self._place.take(message, time_ns)
        self._watch.take(envelope.partition("_")[0], message, time_ns, envelope)  # last: the watch wakes waiting calls
