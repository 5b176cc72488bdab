package afspm.client;

/** The same measurement failed repeatedly without a known reason: a person has to look. */
public class MeasurementFailedException extends AfspmException {
    public MeasurementFailedException(String what) {
        super(what);
    }
}
