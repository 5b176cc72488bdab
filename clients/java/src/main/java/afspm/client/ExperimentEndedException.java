package afspm.client;

/** The experiment has ended: the scheduler takes no more requests. */
public class ExperimentEndedException extends AfspmException {
    public ExperimentEndedException(String what) {
        super(what);
    }
}
