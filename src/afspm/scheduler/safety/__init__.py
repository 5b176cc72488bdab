"""Decisions for the tip: limits at the moment of sending, and the watchdog when a holder dies.

**Theory of operation.** Steps, rates and places are measured from the values in force, which a person or the request
before may have changed. So limits are decided right before a request is sent, and the values that a check depends on
are read from the microscope first. Approvals of agents are checked at the arrival of a request as well.

    comes in      requests; values that were read, set or published; approvals; time
    state         `LimitState`: values in force, and last uses; `GrantBook`; `Watchdog`
    goes out      a refusal with the value, the limit and its place in the experiment file; None: the request is sent
    always holds  no value is clamped; a step, a rate or a place that can't be measured is refused

    module              decides
    `limits`            nothing: it declares each limit, and whether a value is stricter than a driver's default
    `limit_checker`     ranges, steps, rates, intervals, places and pixels
    `forbidden_states`  rules that join quantities, in the language of `rule_language`
    `grants`            approvals of agents, and the limits of roles
    `watchdog`          the scheduler's own actions when a holder loses control, sent by `safety_commands`

To add a limit, follow the recipe in CONTRIBUTING.md, section "How to add": it lists the files in order.
"""
