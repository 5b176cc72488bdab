package afspm.client;

import afspm.Control.ScopeState;
import java.util.LinkedHashMap;
import java.util.Map;

/**
 * One scan or spectrum, followed by published packets: the state {@code busy}, then results, then FREE.
 * After a lost connection the cache may hold the results but not {@code busy}: such results count, too.
 * Pure: takes packets, returns an outcome.
 */
final class Cycle<T> {
    /** The possible ends of a cycle. */
    enum Outcome {
        COMPLETED,
        /** The microscope published an interruption. */
        INTERRUPTED,
        /** The microscope is free without a result, for example after a restart of the translator. */
        VANISHED,
        /** The results do not match the request, for example after a person moved the frame. */
        ANOTHER
    }

    /** The newest result of each name: a restarted translator may publish one twice. */
    final Map<String, T> results = new LinkedHashMap<>();
    private final ScopeState busy;
    private final long sinceNs;
    private boolean isResumed;
    private boolean isBegun;
    private boolean isAnother;
    private Outcome outcome;

    /**
     * @param sinceNs packets up to this time belong to an earlier measurement
     * @param isResumed it was requested in an earlier life, or control was lost: another component may have measured since
     */
    Cycle(ScopeState busy, long sinceNs, boolean isResumed) {
        this.busy = busy;
        this.sinceNs = sinceNs;
        this.isResumed = isResumed;
    }

    boolean isBegun() {
        return isBegun;
    }

    /** Return the outcome; null before the end. */
    Outcome outcome() {
        return outcome;
    }

    /** Note that another component may measure from now on. */
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
            results.clear(); // results from before the start belong to another measurement
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
