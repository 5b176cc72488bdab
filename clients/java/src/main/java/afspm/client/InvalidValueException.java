package afspm.client;

/** A value that has no meaning here: NaN, an empty region, a unit of the wrong dimension. */
public class InvalidValueException extends AfspmException {
    public InvalidValueException(String what) {
        super(what);
    }
}
