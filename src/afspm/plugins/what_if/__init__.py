"""What if: a recorded night, replayed with a changed setting, class or version.

Theory of operation. A component meets its experiment in few places: the events of its port, the readings of its clock,
and its saved memory. With `[record] requests = true` a run keeps them (`client.port_log`). `port_replay` offers them
again to the same or a changed component, which runs in this process, without waiting. `alignment` compares its
requests and messages with the recorded ones. The decisions of the scheduler are pure: `scheduler_replay` steps them
with the recorded inputs (`scheduler.step_log`).

A replay is open loop: once a component decides otherwise, its recorded inputs are those of another night. What comes
after the first difference that reaches the microscope is therefore counterfactual. `closed_loop` runs a simulated night
again instead, and compares the outcomes.

A replay may differ without any change, if the component depends on more than its inputs: `hazards` watches for that.
Nothing outside a temporary folder is written, no program started and no connection made.
"""
