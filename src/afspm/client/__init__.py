"""Components and scripts: the base class of users' components, its loop, and `Scope`, the blocking handle.

**Theory of operation.** A component has one thread, which waits in one place (`experiment_link`) and calls one handler
at a time (`loop`). Packets that arrive meanwhile wait in order (`backlog`). `Scope` offers blocking calls to scripts,
and handles packets while a call waits.

    comes in      packets of the scheduler, answers to requests
    state         the newest state of the experiment; a memory on disk; intent and result of each keyed measurement
    goes out      calls of `on_scan`, `on_problem` … (`dispatch`); requests, repeated with one id until they are
                  answered (`command_retry`)
    always holds  a handler is never interrupted; a keyed measurement is taken exactly once, over any number of kills
                  (`keyed_results`)
"""
