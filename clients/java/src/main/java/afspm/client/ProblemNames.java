package afspm.client;

import afspm.Control.ExperimentProblem;
import java.util.Locale;
import java.util.Map;
import java.util.TreeMap;

/** The problems of an experiment: those of the wire format, and those added by its file. */
final class ProblemNames {
    private final Map<String, Integer> numbers = new TreeMap<>();

    ProblemNames(Map<String, Integer> named) {
        for (ExperimentProblem problem : ExperimentProblem.values()) {
            if (problem != ExperimentProblem.UNRECOGNIZED && problem != ExperimentProblem.EP_NONE) {
                numbers.put(plain(problem.name()), problem.getNumber());
            }
        }
        named.forEach((name, number) -> numbers.put(plain(name), number));
    }

    /** Return the number of a problem such as "tip-shape-changed". */
    int number(String problem) {
        Integer number = numbers.get(plain(problem));
        if (number == null) {
            throw new InvalidValueException("there is no problem " + problem + "; known: " + String.join(", ", numbers.keySet()));
        }
        return number;
    }

    /** Return Return "EP_TIP_SHAPE_CHANGED" and "Tip shape changed" as "tip-shape-changed". */
    private static String plain(String name) {
        return name.trim().toLowerCase(Locale.ROOT).replaceAll("[_ ]", "-").replaceAll("^ep-", "");
    }
}
