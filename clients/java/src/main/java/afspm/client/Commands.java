package afspm.client;

import afspm.Control.ControlRequest;
import afspm.Control.ControlResponse;
import afspm.Control.ScopeState;
import java.util.function.BooleanSupplier;

/** Sends commands to the microscope, repeated with the same id until an answer arrives; a refusal is thrown. */
final class Commands {
    private static final double PATIENCE_S = 60; // longest absence of a translator
    private static final double RETRY_S = 1; // before the next attempt at an unreachable microscope, if nothing is published in between
    private static final double SETTLED_WITHIN_S = 2; // a setting that changed something is published within this time
    private static final double ASK_BUSY_AGAIN_S = 25; // in case the state FREE is never received

    private final Link link;
    private final ControlHold control;

    Commands(Link link, ControlHold control) {
        this.link = link;
        this.control = control;
    }

    /** Repeat a request until it succeeds. The caller holds control; after a loss this waits for control. */
    Response ask(int number, byte[] object, long deadline) {
        String id = link.requests.nextId();
        while (true) {
            control.regain(deadline);
            int states = link.count("ScopeStateMsg");
            Response response = send(number, object, id, deadline, () -> false);
            if (response.ok()) {
                return response;
            }
            if (!response.isUnanswered()) { // otherwise it may have been carried out: repeat with the same id
                getOver(number, response, states, deadline);
                id = link.requests.nextId();
            }
        }
    }

    /** Change a setting, and wait until its {@code message} is published and the tip has stopped moving. */
    void set(int number, byte[] object, String message, long deadline) {
        int count = link.count(message);
        ask(number, object, deadline);
        if (link.await(() -> link.count(message) != count, Time.earlier(SETTLED_WITHIN_S, deadline))) {
            link.await(() -> link.state() != ScopeState.SS_MOVING, deadline);
        }
    }

    /**
     * Send a request and repeat it with the same id while the microscope is silent, so that it is executed once.
     *
     * @param isSeen whether the effect of the request is observed, which counts as an answer
     * @return the answer; one without an outcome only if control was lost before there was any
     */
    Response send(int number, byte[] object, String id, long deadline, BooleanSupplier isSeen) {
        long giveUp = Time.earlier(PATIENCE_S, deadline);
        link.await(() -> link.count("ScopeStateMsg") > 0, giveUp); // a microscope without a published state refuses
        for (boolean isRepeated = false;; isRepeated = true) {
            Response response = link.requests.ask(number, object, id, deadline);
            if (isRepeated && response.isNotInControl()) { // now; the outcome of the earlier attempt is still unknown
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

    /** Wait until the cause of a refusal is gone, or throw the refusal. */
    void getOver(int number, Response response, int states, long deadline) {
        if (response.isUnanswered()) {
            return; // control is lost; the next attempt waits for it
        }
        if (response.isNotInControl()) {
            control.lost(response.reason());
        } else if (response.code() == ControlResponse.REP_NOT_FREE_VALUE) {
            awaitFree(states, deadline);
        } else {
            throw new RefusedException(name(number), response);
        }
    }

    /** Wait for a state FREE newer than {@code states}, with a time limit in case that packet is lost. */
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
