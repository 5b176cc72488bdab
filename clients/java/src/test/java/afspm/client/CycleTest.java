package afspm.client;

import static org.junit.jupiter.api.Assertions.assertEquals;
import static org.junit.jupiter.api.Assertions.assertFalse;

import afspm.Control.ScopeState;
import java.util.Collections;
import org.junit.jupiter.api.Test;

class CycleTest {
    @Test
    void resultsBetweenScanningAndFreeAreThoseOfTheScan() {
        Cycle<String> cycle = new Cycle<>(ScopeState.SS_SCANNING, 10, false);
        cycle.onState(ScopeState.SS_SCANNING, 11);
        cycle.onResult("height", "a scan", true, 12);
        cycle.onState(ScopeState.SS_FREE, 13);
        assertEquals(Cycle.Outcome.COMPLETED, cycle.outcome());
        assertEquals(Collections.singletonMap("height", "a scan"), cycle.results);
    }

    @Test
    void whatWasPublishedBeforeItWasAskedForDoesNotCount() {
        Cycle<String> cycle = new Cycle<>(ScopeState.SS_SCANNING, 10, false);
        cycle.onState(ScopeState.SS_SCANNING, 9);
        cycle.onResult("height", "a scan", true, 10);
        assertFalse(cycle.isBegun());
    }

    @Test
    void aStopARestartAndTheScanOfAnotherAreToldApart() {
        assertEquals(Cycle.Outcome.INTERRUPTED, outcome(ScopeState.SS_INTERRUPTED, false));
        assertEquals(Cycle.Outcome.VANISHED, outcome(ScopeState.SS_FREE, false));
        assertEquals(Cycle.Outcome.ANOTHER, outcome(ScopeState.SS_FREE, true));
    }

    private static Cycle.Outcome outcome(ScopeState last, boolean hasAnother) {
        Cycle<String> cycle = new Cycle<>(ScopeState.SS_SCANNING, -1, false);
        cycle.onState(ScopeState.SS_SCANNING, 1);
        if (hasAnother) {
            cycle.onResult("height", "another's", false, 2);
        }
        cycle.onState(last, 3);
        return cycle.outcome();
    }
}
