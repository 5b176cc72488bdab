package afspm.client;

import java.util.List;

/** A spectrum, and the reasons of earlier interruptions. */
public final class MeasuredSpectrum {
    private final Measurements.Measured<Spectrum> measured;

    MeasuredSpectrum(Measurements.Measured<Spectrum> measured) {
        this.measured = measured;
    }

    public Spectrum spectrum() {
        return measured.things.get(0);
    }

    public List<String> interruptions() {
        return measured.interruptions;
    }
}
