package afspm.client;

import java.util.Collections;
import java.util.HashMap;
import java.util.Map;

/** Conversion of units at the edges: all values inside are in SI (metres, seconds, volts, amperes, radians …). */
public final class Units {
    private static final String[] BASES = {"Hz", "rad", "m", "s", "V", "A", "N", "W", "K"};
    private static final Map<String, Integer> PREFIXES = new HashMap<>();
    private static final Map<String, Units> SPECIAL = new HashMap<>();
    private static final Map<String, String> OF_PARAMETERS = new HashMap<>();

    static {
        Object[] prefixes = {"", 0, "k", 3, "M", 6, "m", -3, "u", -6, "\u00b5", -6, "\u03bc", -6, "n", -9, "p", -12, "f", -15};
        for (int i = 0; i < prefixes.length; i += 2) {
            PREFIXES.put((String) prefixes[i], (Integer) prefixes[i + 1]);
        }
        Units number = new Units("", 0, 1);
        Units angstrom = new Units("m", -10, 1);
        Units degree = new Units("rad", 0, Math.PI / 180);
        Object[] special = {
            "", number, "1", number, "%", new Units("", -2, 1), "px", new Units("px", 0, 1),
            "\u00c5", angstrom, "\u212b", angstrom, "angstrom", angstrom,
            "deg", degree, "\u00b0", degree, "degree", degree, "degrees", degree,
            "min", new Units("s", 0, 60), "h", new Units("s", 0, 3600),
        };
        for (int i = 0; i < special.length; i += 2) {
            SPECIAL.put((String) special[i], (Units) special[i + 1]);
        }
        String[] parameters = {
            "scan-top-left-x", "m", "scan-top-left-y", "m", "scan-size-x", "m", "scan-size-y", "m", "scan-angle", "rad",
            "scan-resolution-x", "px", "scan-resolution-y", "px", "zctrl-pgain", "", "zctrl-igain", "",
            "sample-slope-x", "", "sample-slope-y", "", "scan-speed", "m/s", "move-speed", "m/s",
            "probe-pos-x", "m", "probe-pos-y", "m", "tip-bias-voltage", "V",
        };
        for (int i = 0; i < parameters.length; i += 2) {
            OF_PARAMETERS.put(parameters[i], parameters[i + 1]);
        }
    }

    private final String base;
    /** The power of ten, separate from the factor: a division by it rounds less than a product with its inverse. */
    private final int power;
    private final double factor;

    private Units(String base, int power, double factor) {
        this.base = base;
        this.power = power;
        this.factor = factor;
    }

    /** Return the SI units of the base parameters that do not depend on the operating mode of the microscope. */
    public static Map<String, String> ofParameters() {
        return Collections.unmodifiableMap(OF_PARAMETERS);
    }

    /** Return a value of the unit {@code from} in the unit {@code to}, such as {@code convert(2, "um/s", "m/s")}. */
    public static double convert(double value, String from, String to) {
        if (from.equals(to)) {
            return value;
        }
        Units given = parse(from);
        Units wanted = parse(to);
        if (!given.base.equals(wanted.base)) {
            throw new InvalidValueException("'" + from + "' can't be converted to '" + to + "'");
        }
        int power = given.power - wanted.power;
        double scaled = value * (given.factor / wanted.factor);
        return power < 0 ? scaled / Math.pow(10, -power) : scaled * Math.pow(10, power);
    }

    private static Units parse(String unit) {
        String[] parts = unit.trim().split("/", -1);
        if (parts.length == 1) {
            return single(parts[0]);
        }
        if (parts.length > 2) {
            throw new InvalidValueException("the unit '" + unit + "' is not known");
        }
        Units over = single(parts[0]);
        Units under = single(parts[1]);
        return new Units(over.base + "/" + under.base, over.power - under.power, over.factor / under.factor);
    }

    private static Units single(String unit) {
        Units special = SPECIAL.get(unit);
        if (special != null) {
            return special;
        }
        for (String base : BASES) {
            Integer power = unit.endsWith(base) ? PREFIXES.get(unit.substring(0, unit.length() - base.length())) : null;
            if (power != null) {
                return new Units(base, power, 1);
            }
        }
        throw new InvalidValueException("the unit '" + unit + "' is not known");
    }
}
