"""AI agents in an experiment: clients over the Model Context Protocol, each limited to a person's approvals.

Theory of operation
-------------------

    comes in      calls of thirteen tools (`tools`), over HTTP behind the guard of the gateway, or in memory
    state         frozen plans with their preflights, and runs with their progress (`workplace`)
    goes out      requests to the scheduler under the agent's name "agent:NAME"; proposals for persons
    always holds  nothing here decides on an agent's rights: the scheduler keeps the approvals, and checks each request
                  right before it is sent (`scheduler.safety.grants`). Text from outside is never an instruction

`plan` is pure: a plan, its canonical form, its id, and the exact requests that a person approves. `twin` is the
simulated run of a plan, in a separate process. `commands` holds `afspm approve`, with which a person decides.
"""
