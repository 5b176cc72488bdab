"""SECoP instruments (a cryostat, a magnet, a lock-in amplifier …) as components of the experiment.

**Theory of operation.** SECoP is a protocol of text lines and JSON (https://sampleenvironment.github.io/secop-site).
The client reads the value, status and target of each module about once a second, and reports values and targets to the
scheduler; the answer to a report contains the targets to set.

    comes in      lines of the SECoP server; orders of the scheduler; time
    state         `SecopClient`: the server's description, the newest values, the order in progress
    goes out      lines to the server; readings and outcomes for the scheduler
    always holds  the age of a value counts from its request, on this computer's own clock; a
                  target is sent in the unit that the server described first; a limited rate is kept by the server's own
                  ramp, which is read back, or by steps of the target

    module          decides
    `lines`         one line of the protocol, to and from text
    `secop_client`  everything else, without socket and clock
    `instrument`    the component, with its socket
"""
