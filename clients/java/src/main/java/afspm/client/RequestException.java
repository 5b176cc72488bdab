package afspm.client;

/** Base of the errors of a request. */
public class RequestException extends AfspmException {
    private final int code;
    private final String reason;
    private final int detail;

    RequestException(String what, int code, String reason, int detail) {
        super(what + ": " + (reason.isEmpty() ? Response.name(code) : reason) + " (" + Response.name(code) + ")");
        this.code = code;
        this.reason = reason;
        this.detail = detail;
    }

    /** Return the number of the response, see {@code ControlResponse}. */
    public int code() {
        return code;
    }

    /** Return the name of the response, such as "REP_PARAM_ERROR". */
    public String response() {
        return Response.name(code);
    }

    /** Return the reason, for a person. */
    public String reason() {
        return reason;
    }

    /** Return one of the details of {@link Response}, 0 for none. */
    public int detail() {
        return detail;
    }
}
