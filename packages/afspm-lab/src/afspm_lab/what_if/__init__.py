"""`afspm what-if`: replay of a recorded run with a changed setting, class or version.

Theory of operation. A component depends on the experiment only through the events of its port, the readings of its
clock, and its saved memory. With `[record] requests = true` a run records them (`client.port_log`). `port_replay`
offers them again to the same or a changed component, which runs in this process, without waiting. `alignment` compares
its requests and messages with the recorded outputs. The decisions of the scheduler are pure: `scheduler_replay` steps
them with the recorded inputs (`scheduler.step_log`).

A replay is open loop: after a component has decided otherwise, its recorded inputs no longer match its decisions.
Everything after the first difference that reaches the microscope is therefore counterfactual. `closed_loop` runs a
simulated night again instead, and compares the outcomes.

A replay may differ without any change if the component depends on more than its inputs, which `hazards` detects.
`hazards` also keeps the component from writing outside a temporary folder, starting programs and making connections.
"""
