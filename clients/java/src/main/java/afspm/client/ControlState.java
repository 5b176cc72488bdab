package afspm.client;

import afspm.Control.ControlMode;
import java.util.Collections;
import java.util.List;
import java.util.stream.Collectors;

/** Mode, holder of control and problems. */
public final class ControlState {
    private final ControlMode mode;
    private final String holder;
    private final List<Integer> problems;

    ControlState(afspm.Control.ControlState message) {
        mode = message.getControlMode();
        holder = message.getClientInControlId();
        problems = Collections.unmodifiableList(message.getProblemsSetValueList().stream().collect(Collectors.toList()));
    }

    /** Return "CM_MANUAL", "CM_AUTOMATED" or "CM_UNDEFINED". */
    public String mode() {
        return mode.name();
    }

    /** Return the name of the component in control; empty: none. */
    public String holder() {
        return holder;
    }

    /** Return the numbers of the flagged problems. */
    public List<Integer> problems() {
        return problems;
    }

    boolean isManual() {
        return mode == ControlMode.CM_MANUAL;
    }
}
