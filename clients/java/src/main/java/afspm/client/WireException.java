package afspm.client;

/** Bytes from a peer that are not what the wire format says. */
public class WireException extends AfspmException {
    public WireException(String what) {
        super(what);
    }
}
