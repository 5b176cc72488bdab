"""The Microscope Translator: the process between the scheduler and one microscope, around a maker's `Driver`.

**Theory of operation.** One loop waits for requests and for the next reading of the controller.

    inputs        requests of the scheduler; readings of the driver from the controller
    state         the last published state of the microscope; answers to recent requests; names of the results already
                  published (all on disk)
    outputs       commands to the controller; states, settings, scans and spectra as packets
    invariants    a request is checked as a whole before anything is set; no request is executed twice; only one
                  scheduler is obeyed (`fencing`); a result reaches a subscriber once, even after a kill (`outbox`);
                  when no process is left to command, the measurement is stopped, and the tip is retracted if a request
                  has switched its feedback off (`safe_exit`)

A driver (`driver`) reads and sets the parameters of its table (`parameters`), starts and stops measurements, and
returns their results. A driver may fail at any time with `ControllerLost`; the translator reconnects.
"""
