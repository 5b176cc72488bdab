package afspm.client;

/** Bytes from a peer that violate the wire format. */
public class WireException extends AfspmException {
    public WireException(String what) {
        super(what);
    }
}
