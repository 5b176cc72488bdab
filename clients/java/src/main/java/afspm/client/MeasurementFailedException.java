package afspm.client;

/** The microscope fails again and again at the same measurement: a person should look. */
public class MeasurementFailedException extends AfspmException {
    public MeasurementFailedException(String what) {
        super(what);
    }
}
