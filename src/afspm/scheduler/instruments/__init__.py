"""Other instruments: their last readings, and the conditions that they set for measuring.

**Theory of operation.** Each instrument is a component that reports its values several times a second (request 102). A
parameter "cryo.temperature" belongs to the component `cryo`. A request to read it is answered from the last report,
unless the run may have changed something since then. It becomes an order to measure in this case, as does a request for
"cryo.temperature.now". A request to set it becomes an order, too. The answer to a report carries one order. It is held
back for a moment until there is an order, if the report allows it. A later report carries the outcome.

    comes in      reports with values and outcomes; requests for parameters of instruments; time
    state         `Instruments`: the last reading of each parameter, its first unit, open orders, since when each
                  condition holds
    goes out      orders; a refusal of the actions that a condition guards; the problems to flag and to clear
    always holds  a reading older than `OLDEST_S`, or in another unit than the first, does not count; a report is dated
                  by the scheduler's own clock, never by the clock of the instrument's computer; no value is from
                  before a request of the run that has changed something
"""
