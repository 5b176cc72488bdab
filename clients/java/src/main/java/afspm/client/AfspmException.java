package afspm.client;

/** The base of all errors of this library. They are unchecked: most end the component, and its supervisor restarts it. */
public class AfspmException extends RuntimeException {
    public AfspmException(String what) {
        super(what);
    }

    public AfspmException(String what, Throwable cause) {
        super(what, cause);
    }
}
