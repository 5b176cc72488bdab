package afspm.client;

import afspm.Control.ScopeState;
import java.util.LinkedHashMap;
import java.util.Map;

/**
 * One scan or spectrum, followed through what the scheduler publishes: the state {@code busy}, then results, then FREE.
 * While a connection was lost the cache may have kept the results and not {@code busy}: then they are taken for ours, too.
 * Pure: packets in, an outcome out.
 */
final class Cycle<T> {
    /** How a cycle may end. */
    enum Outcome {
        COMPLETED,
        /** The microscope says that it was stopped. */
        INTERRUPTED,
        /** The microscope is free and there is nothing: it was started anew in the middle, say. */
        VANISHED,
        /** The results can't be those asked for: a person at the panel has moved the frame, say. */
        ANOTHER
    }

    /** The newest result of each name: a restarted translator may have published one twice. */
    final Map<String, T> results = new LinkedHashMap<>();
    private final ScopeState busy;
    private final long sinceNs;
    private boolean isResumed;
    private boolean isBegun;
    private boolean isAnother;
    private Outcome outcome;

    /**
     * @param sinceNs what is not newer belongs to something earlier
     * @param isResumed it was asked for in an earlier life of ours, or control was lost: another may have measured since
     */
    Cycle(ScopeState busy, long sinceNs, boolean isResumed) {
        this.busy = busy;
        this.sinceNs = sinceNs;
        this.isResumed = isResumed;
    }

    boolean isBegun() {
        return isBegun;
    }

    /** Return how it ended; null while it goes on. */
    Outcome outcome() {
        return outcome;
    }

    /** Another component may measure from now on. */
    void controlWasLost() {
        isResumed = true;
    }

    void vanish() {
        outcome = Outcome.VANISHED;
    }

    void onState(ScopeState state, long timeNs) {
        if (isOver(timeNs)) {
            return;
        }
        if (state == busy) {
            results.clear(); // what came before this began belongs to another
            isAnother = false;
            isBegun = true;
        } else if (isBegun && state == ScopeState.SS_INTERRUPTED) {
            outcome = Outcome.INTERRUPTED;
        } else if (isBegun && state == ScopeState.SS_FREE) {
            outcome = !results.isEmpty() ? Outcome.COMPLETED : isAnother ? Outcome.ANOTHER : Outcome.VANISHED;
        }
    }

    void onResult(String name, T result, boolean fits, long timeNs) {
        if (isOver(timeNs)) {
            return;
        }
        if (fits) {
            isBegun = true;
            results.put(name, result);
        } else {
            isAnother |= isBegun;
        }
    }

    private boolean isOver(long timeNs) {
        return outcome != null || (timeNs == 0 ? isResumed : timeNs <= sinceNs);
    }
}
