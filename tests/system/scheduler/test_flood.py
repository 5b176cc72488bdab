"""A client that sends thousands of reads holds up no other client: through real processes and sockets."""

from __future__ import annotations

from scheduler_rig import Rig

from afspm.model import CLOCK_REQUEST, ControlRequest, Request, Response

READS = 20_000


def test_command_of_the_holder_is_sent_before_the_waiting_reads_of_a_flooding_client(rig: Rig) -> None:
    # faults A2
    rig.start()
    holder, flooder = rig.component("Holder"), rig.component("Flooder")
    rig.linked(holder)
    assert holder.ask(ControlRequest.REQUEST_CTRL, 0).ok
    asked: list[Request] = []

    def answer(request: Request) -> Response:
        if not asked:  # nothing is answered before the command waits in the scheduler
            for _ in range(READS):
                flooder.send(ControlRequest.ACTION_SUPPORT, "start-scan")
            command = holder.send(ControlRequest.ACTION, "start-scan")
            known = holder.send(CLOCK_REQUEST)
            translator, rig.translator = rig.translator, None
            rig.until(lambda: holder.answer_to(known))
            assert holder.answer_to(command) is None
            rig.translator = translator
        asked.append(request)
        return Response(0, id=request.id)

    rig.answer = answer
    flooder.send(ControlRequest.ACTION_SUPPORT, "start-scan")
    rig.until(lambda: any(request.kind == ControlRequest.ACTION for request in asked))
    assert [request.kind for request in asked[:2]] == [ControlRequest.ACTION_SUPPORT, ControlRequest.ACTION]
