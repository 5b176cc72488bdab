package afspm.client;

import java.util.AbstractList;
import java.util.List;

/** All channels of a scan. */
public final class ScanSet extends AbstractList<Scan> {
    private final List<Scan> scans;
    private final List<String> interruptions;

    ScanSet(Measurements.Measured<Scan> measured) {
        scans = measured.things;
        interruptions = measured.interruptions;
    }

    @Override
    public Scan get(int index) {
        return scans.get(index);
    }

    @Override
    public int size() {
        return scans.size();
    }

    /** Return a channel by its name. */
    public Scan channel(String name) {
        return scans.stream().filter(scan -> scan.channel().equals(name)).findFirst()
                .orElseThrow(() -> new InvalidValueException("no channel " + name));
    }

    /** Return the reasons of interruptions before this scan was complete. */
    public List<String> interruptions() {
        return interruptions;
    }
}
