package afspm.client;

/** There is nothing more to ask. */
public class ExperimentEndedException extends AfspmException {
    public ExperimentEndedException(String what) {
        super(what);
    }
}
