package afspm.client;

/** Standard input has ended: the supervisor stops this process, or is gone. */
public class StopRequestedException extends AfspmException {
    public StopRequestedException(String what) {
        super(what);
    }
}
