package afspm.client;

/** A refusal by the scheduler, a limit or the microscope. */
public class RefusedException extends RequestException {
    RefusedException(String what, Response response) {
        super(what, response.code(), response.reason(), response.detail());
    }
}
