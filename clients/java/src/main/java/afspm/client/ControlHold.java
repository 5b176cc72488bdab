package afspm.client;

import afspm.Control.ControlRequest;
import afspm.Control.ControlResponse;
import java.util.function.Supplier;

/**
 * This component's hold on control: requests it, waits for it, notices its loss, releases it. Answers of
 * the scheduler grant control; its published state revokes it, once a state has named this component: a state from
 * before the grant may still be in transit.
 */
final class ControlHold {
    private static final double ASK_AGAIN_S = 10; // in case a published control state is not received

    private final Link link;
    private boolean isHeld;
    private boolean wasNamed;
    private boolean isKept;
    private String whyLost = "";
    private int depth;
    private int solving;

    ControlHold(Link link) {
        this.link = link;
        link.listeners.add((packet, isScheduler) -> {
            if (isScheduler && packet.value() instanceof ControlState) {
                take((ControlState) packet.value());
            }
        });
    }

    boolean isHeld() {
        synchronized (link) {
            return isHeld;
        }
    }

    /** Whether control is wanted and not held. */
    boolean wasLost() {
        synchronized (link) {
            return depth > 0 && !isHeld;
        }
    }

    String whyLost() {
        synchronized (link) {
            return whyLost;
        }
    }

    /** Hold control while {@code body} runs; a nested call shares the control of the outer one. */
    <T> T hold(Supplier<T> body, int problem, long deadline) {
        acquire(problem, deadline);
        try {
            return body.get();
        } finally {
            relinquish();
        }
    }

    /** Hold control until {@link #relinquish} was called as often. */
    void acquire(int problem, long deadline) {
        synchronized (link) {
            if (depth > 0 && problem != 0 && problem != solving) {
                throw new InvalidValueException("control is held to solve problem " + solving + ", not " + problem);
            }
            solving = depth == 0 ? problem : solving;
            depth += 1;
        }
        try {
            regain(deadline);
        } catch (RuntimeException error) {
            relinquish();
            throw error;
        }
    }

    void relinquish() {
        boolean isLast;
        synchronized (link) {
            depth -= depth > 0 ? 1 : 0;
            isLast = depth == 0;
        }
        if (isLast) {
            release();
        }
    }

    /** Hold control until {@link #giveUp} is called; a second call only checks that it is held. */
    void keep(int problem, long deadline) {
        if (!isKept) {
            acquire(problem, deadline);
        } else if (problem == solving) {
            regain(deadline);
        } else {
            change(problem, deadline);
        }
        isKept = true;
    }

    /** Hold control for another problem than now, if the scheduler allows it. */
    private void change(int problem, long deadline) {
        Response response = link.requests.ask(ControlRequest.REQ_REQUEST_CTRL_VALUE, new byte[] {(byte) problem}, deadline);
        if (!response.ok()) {
            throw new RefusedException("control", response);
        }
        link.change(() -> {
            solving = problem;
            isHeld = true;
        });
    }

    void giveUp() {
        if (isKept) {
            relinquish();
        }
        isKept = false;
    }

    /** Return once in control: request it, wait for the control state to change, and request again. */
    void regain(long deadline) {
        String reported = "";
        Response refusal = null;
        while (!isHeld()) {
            int states = link.count("ControlState");
            int connections = link.requests.connections();
            try {
                refusal = ask(deadline);
            } catch (NoResponseException error) {
                if (refusal == null || !Time.isOver(deadline)) {
                    throw error;
                } // otherwise the newest published state is the answer
            }
            if (refusal == null) {
                return;
            }
            String obstacle = refusal.reason().isEmpty() ? obstacle() : refusal.reason();
            if (!obstacle.equals(reported)) {
                Link.LOG.info(link.launch.name + " waits for control: " + obstacle);
            }
            reported = obstacle;
            link.await(() -> connections != link.requests.connections()
                    || (link.count("ControlState") != states && (isSolved() || obstacle().isEmpty())), Time.earlier(ASK_AGAIN_S, deadline));
            if (Time.isOver(deadline)) {
                throw new ControlLostException("control was not given in time", refusal);
            }
        }
    }

    /** Release control that an earlier life of this component held and that is not wanted now. */
    void releaseInherited() {
        ControlState state = link.control();
        boolean isInherited;
        synchronized (link) {
            isInherited = depth == 0 && !isHeld && state != null && state.holder().equals(link.launch.name);
        }
        if (isInherited) {
            link.requests.sendOnly(ControlRequest.REQ_RELEASE_CTRL_VALUE);
        }
    }

    /** Note the scheduler's answer that this component is not in control. */
    void lost(String why) {
        link.change(() -> {
            isHeld = false;
            whyLost = why;
        });
    }

    /** Release control if it is held. */
    void release() {
        if (!isHeld()) {
            return;
        }
        link.change(() -> isHeld = false);
        if (link.over() != null) {
            link.requests.sendOnly(ControlRequest.REQ_RELEASE_CTRL_VALUE);
            return;
        }
        try {
            link.requests.ask(ControlRequest.REQ_RELEASE_CTRL_VALUE, Requests.NOTHING, Time.deadline(link.launch.requestTimeoutS));
        } catch (AfspmException error) {
            Link.LOG.fine("control was not given back: " + error.getMessage());
        }
    }

    /** Request control once. Return a refusal that may pass with time; null: control is granted. */
    private Response ask(long deadline) {
        Response response = link.requests.ask(ControlRequest.REQ_REQUEST_CTRL_VALUE, new byte[] {(byte) solving}, deadline);
        switch (response.code()) {
            case ControlResponse.REP_SUCCESS_VALUE:
                link.change(() -> {
                    isHeld = true;
                    wasNamed = link.control() != null && link.control().holder().equals(link.launch.name);
                });
                return null;
            case ControlResponse.REP_WRONG_EXP_PROBLEM_VALUE:
                if (isSolved()) {
                    throw new ControlLostException("problem " + solving + " is not flagged: there is nothing to solve", response);
                }
                return response;
            case ControlResponse.REP_ALREADY_UNDER_CONTROL_VALUE:
            case ControlResponse.REP_WRONG_CONTROL_MODE_VALUE:
                return response;
            default:
                throw new RefusedException("control", response);
        }
    }

    private boolean isSolved() {
        return solving != 0 && (link.control() == null || !link.control().problems().contains(solving));
    }

    /** Return the reason why control is withheld, for a person; empty without one. */
    private String obstacle() {
        ControlState state = link.control();
        if (state == null) {
            return "";
        }
        if (state.isManual()) {
            return "the mode is MANUAL";
        }
        if (solving != 0 ? !state.problems().contains(solving) : !state.problems().isEmpty()) {
            return "problems " + state.problems() + " are flagged";
        }
        return state.holder().isEmpty() || state.holder().equals(link.launch.name) ? "" : state.holder() + " is in control";
    }

    private void take(ControlState state) {
        if (!isHeld) {
            return;
        }
        if (state.holder().equals(link.launch.name)) {
            wasNamed = true;
        } else if (wasNamed) {
            String obstacle = obstacle();
            lost(obstacle.isEmpty() ? "it was revoked" : obstacle);
        }
    }
}
