package afspm.client;

import afspm.Control.ControlRequest;
import afspm.Control.ControlResponse;
import afspm.Control.ScopeState;
import java.util.function.BooleanSupplier;

/** Commands to the microscope, repeated with the same id until they are answered, and refused loudly. */
final class Commands {
    private static final double PATIENCE_S = 60; // that a translator may take to be there again
    private static final double RETRY_S = 1; // before an unreachable one is asked again, when nothing is published in between
    private static final double SETTLED_WITHIN_S = 2; // what was set is published, if it changed anything
    private static final double ASK_BUSY_AGAIN_S = 25; // should the state FREE never reach us

    private final Link link;
    private final ControlHold control;

    Commands(Link link, ControlHold control) {
        this.link = link;
        this.control = control;
    }

    /** Ask until it succeeds. Control must be held around it; where it is lost it is waited for. */
    Response ask(int number, byte[] object, long deadline) {
        String id = link.requests.nextId();
        while (true) {
            control.regain(deadline);
            int states = link.count("ScopeStateMsg");
            Response response = send(number, object, id, deadline, () -> false);
            if (response.ok()) {
                return response;
            }
            if (!response.isUnanswered()) { // else it may have been carried out: the same id again
                getOver(number, response, states, deadline);
                id = link.requests.nextId();
            }
        }
    }

    /** Ask for a setting, and wait until its {@code message} is published and the tip has stopped moving. */
    void set(int number, byte[] object, String message, long deadline) {
        int count = link.count(message);
        ask(number, object, deadline);
        if (link.await(() -> link.count(message) != count, Time.earlier(SETTLED_WITHIN_S, deadline))) {
            link.await(() -> link.state() != ScopeState.SS_MOVING, deadline);
        }
    }

    /**
     * Ask once, with patience for a microscope that is silent: the same id has it executed once.
     *
     * @param isSeen whether what was asked for is seen to happen, which is as good as an answer
     * @return the answer; one without an outcome only if control was lost before there was any
     */
    Response send(int number, byte[] object, String id, long deadline, BooleanSupplier isSeen) {
        long giveUp = Time.earlier(PATIENCE_S, deadline);
        link.await(() -> link.count("ScopeStateMsg") > 0, giveUp); // a microscope that has not said a word would refuse
        for (boolean isRepeated = false;; isRepeated = true) {
            Response response = link.requests.ask(number, object, id, deadline);
            if (isRepeated && response.isNotInControl()) { // now; whether it was done before is still unknown
                control.lost(response.reason());
                return response.as(ControlResponse.REP_NO_RESPONSE_VALUE);
            }
            if (!response.isUnanswered() || control.wasLost()) {
                return response;
            }
            if (link.holds(isSeen)) {
                return response.as(ControlResponse.REP_SUCCESS_VALUE);
            }
            if (Time.isOver(giveUp)) {
                throw new NoResponseException(name(number), "the microscope does not answer: " + response.reason(), response.detail());
            }
            if (!isRepeated) {
                Link.LOG.warning("the microscope does not answer " + name(number) + " (" + response.reason() + "); asking again");
            }
            int news = news();
            link.await(() -> news() != news, Time.earlier(RETRY_S, giveUp));
        }
    }

    /** After a refusal: wait for what stands in the way, or throw it. */
    void getOver(int number, Response response, int states, long deadline) {
        if (response.isUnanswered()) {
            return; // control is lost, and waited for when it is asked again
        }
        if (response.isNotInControl()) {
            control.lost(response.reason());
        } else if (response.code() == ControlResponse.REP_NOT_FREE_VALUE) {
            awaitFree(states, deadline);
        } else {
            throw new RefusedException(name(number), response);
        }
    }

    /** Wait until the microscope says that it is free, later than {@code states}; not for ever, should that get lost. */
    private void awaitFree(int states, long deadline) {
        double patienceS = link.state() == ScopeState.SS_FREE ? RETRY_S : ASK_BUSY_AGAIN_S;
        link.await(() -> link.state() == ScopeState.SS_FREE && link.count("ScopeStateMsg") != states, Time.earlier(patienceS, deadline));
        if (Time.isOver(deadline)) {
            throw new NoResponseException("the microscope was not free in time", link.state().name(), Response.NOT_SENT);
        }
    }

    private int news() {
        return link.count("ScopeStateMsg") + link.count("ControlState");
    }

    private static String name(int number) {
        ControlRequest known = ControlRequest.forNumber(number);
        return known == null ? "request " + number : known.name();
    }
}
