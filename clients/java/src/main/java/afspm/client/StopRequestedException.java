package afspm.client;

/** Standard input has ended: the supervisor wants this process to end, or is dead. */
public class StopRequestedException extends AfspmException {
    public StopRequestedException(String what) {
        super(what);
    }
}
