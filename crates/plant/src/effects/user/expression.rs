//! An expression in the usual notation, compiled once to a list of steps that run without allocation.
//!
//! `+ - * / % ^`, comparisons and `&&`, `||`, `!` (1 for true, 0 for false), parentheses, numbers, names, and the functions of
//! [`FUNCTIONS`]. The crate `fasteval3` parses and folds constants. Its evaluation looks up names as text and allocates for
//! functions, so this module compiles its result again, with a slot for every name.

use fasteval3::compiler::{IC, Instruction, InstructionI};
use fasteval3::{Compiler, EmptyNamespace, Parser, Slab};

/// What is wrong with a part of a definition, and what would be right.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct ExpressionProblem(pub String);

type OfOne = (&'static str, fn(f64) -> f64);

/// Functions of one number, besides those of two or more.
const OF_ONE: &[OfOne] = &[
    ("sqrt", f64::sqrt),
    ("exp", f64::exp),
    ("ln", f64::ln),
    ("cbrt", f64::cbrt),
];

/// The functions that an expression may call.
pub const FUNCTIONS: &[&str] = &[
    "abs", "sign", "min", "max", "sqrt", "cbrt", "exp", "ln", "log", "sin", "cos", "tan", "asin",
    "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh", "floor", "ceil", "int",
    "round", "pi", "e",
];

/// Deepest nesting of operands not yet combined.
const DEEPEST: usize = 24;

/// Most steps of an expression.
const LONGEST: usize = 256;

#[derive(Debug, Clone, Copy)]
enum Step {
    Number(f64),
    Name(usize),
    One(fn(f64) -> f64),
    Two(fn(f64, f64) -> f64),
}

/// A compiled expression.
#[derive(Debug, Clone)]
pub(super) struct Program {
    steps: Vec<Step>,
    names: Vec<usize>,
}

impl Program {
    /// Compiles a text that may contain `names`.
    ///
    /// # Errors
    /// A text that is not an expression, an unknown name or function: what is wrong and what would be right.
    pub(super) fn new(text: &str, names: &[&str]) -> Result<Self, ExpressionProblem> {
        minus_before_power(text)?;
        let mut slab = Slab::new();
        let parsed = Parser::new().parse(text, &mut slab.ps).map_err(|e| {
            ExpressionProblem(format!("`{text}` is no expression: {}", in_words(&e)))
        })?;
        let top = parsed
            .from(&slab.ps)
            .compile(&slab.ps, &mut slab.cs, &mut EmptyNamespace);
        let mut builder = Builder {
            slab: &slab,
            names,
            program: Self {
                steps: Vec::new(),
                names: Vec::new(),
            },
        };
        builder.instruction(&top)?;
        let program = builder.program;
        if program.steps.len() > LONGEST || program.depth() > DEEPEST {
            return Err(ExpressionProblem(format!(
                "`{text}` is too long: at most {LONGEST} numbers, names and operators, nested at most {DEEPEST} deep"
            )));
        }
        Ok(program)
    }

    fn depth(&self) -> usize {
        let (mut now, mut most) = (0_usize, 0);
        for step in &self.steps {
            match step {
                Step::Number(_) | Step::Name(_) => now += 1,
                Step::One(_) => {}
                Step::Two(_) => now = now.saturating_sub(1),
            }
            most = most.max(now);
        }
        most
    }

    /// Whether the name of this place occurs.
    pub(super) fn uses(&self, name: usize) -> bool {
        self.names.contains(&name)
    }

    /// Its value; the names have these `values`, in the order given at compilation. Allocates nothing.
    pub(super) fn value(&self, values: &[f64]) -> f64 {
        let mut stack = [0.0_f64; DEEPEST];
        let mut top = 0;
        for step in &self.steps {
            match *step {
                Step::Number(x) => {
                    stack[top] = x;
                    top += 1;
                }
                Step::Name(i) => {
                    stack[top] = values.get(i).copied().unwrap_or(f64::NAN);
                    top += 1;
                }
                Step::One(f) => stack[top - 1] = f(stack[top - 1]),
                Step::Two(f) => {
                    stack[top - 2] = f(stack[top - 2], stack[top - 1]);
                    top -= 1;
                }
            }
        }
        stack[0]
    }
}

/// Puts compiled instructions into the order of their evaluation.
struct Builder<'a> {
    slab: &'a Slab,
    names: &'a [&'a str],
    program: Program,
}

fn truth(yes: bool) -> f64 {
    f64::from(u8::from(yes))
}

fn sign(x: f64) -> f64 {
    if x == 0.0 { 0.0 } else { x.signum() }
}

/// Whole and half-integer powers are far cheaper than the general one.
fn power(x: f64, y: f64) -> f64 {
    if y == 2.0 {
        x * x
    } else if y == 3.0 {
        x * x * x
    } else if y == 0.5 {
        x.sqrt()
    } else if y.abs() <= 64.0 && y.fract() == 0.0 {
        x.powi(y as i32)
    } else {
        x.powf(y)
    }
}

impl Builder<'_> {
    fn push(&mut self, step: Step) -> Result<(), ExpressionProblem> {
        self.program.steps.push(step);
        Ok(())
    }

    fn number(&mut self, ic: &IC) -> Result<(), ExpressionProblem> {
        match ic {
            IC::C(x) => self.push(Step::Number(*x)),
            IC::I(i) => self.at(*i),
        }
    }

    fn at(&mut self, i: InstructionI) -> Result<(), ExpressionProblem> {
        let slab = self.slab;
        self.instruction(slab.cs.get_instr(i))
    }

    fn one(&mut self, i: InstructionI, f: fn(f64) -> f64) -> Result<(), ExpressionProblem> {
        self.at(i)?;
        self.push(Step::One(f))
    }

    fn two(&mut self, a: &IC, b: &IC, f: fn(f64, f64) -> f64) -> Result<(), ExpressionProblem> {
        self.number(a)?;
        self.number(b)?;
        self.push(Step::Two(f))
    }

    fn instruction(&mut self, instruction: &Instruction) -> Result<(), ExpressionProblem> {
        use Instruction as I;
        match instruction {
            I::IConst(x) => self.push(Step::Number(*x)),
            I::IVar(name) => self.name(name),
            I::IFunc { name, args } => self.function(name, args),
            I::INeg(i) => self.one(*i, |x| -x),
            I::INot(i) => self.one(*i, |x| truth(x == 0.0)),
            I::IInv(i) => self.one(*i, |x| 1.0 / x),
            I::IAdd(a, b) => self.two(&IC::I(*a), b, |a, b| a + b),
            I::IMul(a, b) => self.two(&IC::I(*a), b, |a, b| a * b),
            I::IMod { dividend, divisor } => self.two(dividend, divisor, |a, b| a % b),
            I::IExp { base, power: by } => self.two(base, by, power),
            I::ILT(a, b) => self.two(a, b, |a, b| truth(a < b)),
            I::ILTE(a, b) => self.two(a, b, |a, b| truth(a <= b)),
            I::IEQ(a, b) => self.two(a, b, |a, b| truth(a == b)),
            I::INE(a, b) => self.two(a, b, |a, b| truth(a != b)),
            I::IGTE(a, b) => self.two(a, b, |a, b| truth(a >= b)),
            I::IGT(a, b) => self.two(a, b, |a, b| truth(a > b)),
            I::IOR(a, b) => self.two(&IC::I(*a), b, |a, b| truth(a != 0.0 || b != 0.0)),
            I::IAND(a, b) => self.two(&IC::I(*a), b, |a, b| truth(a != 0.0 && b != 0.0)),
            I::IFuncMin(a, b) => self.two(&IC::I(*a), b, f64::min),
            I::IFuncMax(a, b) => self.two(&IC::I(*a), b, f64::max),
            I::IFuncLog { base, of } => self.two(base, of, |base, x| x.log(base)),
            I::IFuncRound { modulus, of } => self.two(modulus, of, |m, x| (x / m).round() * m),
            other => self.of_one_builtin(other),
        }
    }

    fn of_one_builtin(&mut self, instruction: &Instruction) -> Result<(), ExpressionProblem> {
        use Instruction as I;
        match instruction {
            I::IFuncInt(i) => self.one(*i, f64::trunc),
            I::IFuncCeil(i) => self.one(*i, f64::ceil),
            I::IFuncFloor(i) => self.one(*i, f64::floor),
            I::IFuncAbs(i) => self.one(*i, f64::abs),
            I::IFuncSign(i) => self.one(*i, sign),
            I::IFuncSin(i) => self.one(*i, f64::sin),
            I::IFuncCos(i) => self.one(*i, f64::cos),
            I::IFuncTan(i) => self.one(*i, f64::tan),
            I::IFuncASin(i) => self.one(*i, f64::asin),
            I::IFuncACos(i) => self.one(*i, f64::acos),
            I::IFuncATan(i) => self.one(*i, f64::atan),
            I::IFuncSinH(i) => self.one(*i, f64::sinh),
            I::IFuncCosH(i) => self.one(*i, f64::cosh),
            I::IFuncTanH(i) => self.one(*i, f64::tanh),
            I::IFuncASinH(i) => self.one(*i, f64::asinh),
            I::IFuncACosH(i) => self.one(*i, f64::acosh),
            I::IFuncATanH(i) => self.one(*i, f64::atanh),
            _ => Err(ExpressionProblem(
                "`print` is no function of an effect".to_owned(),
            )),
        }
    }

    fn name(&mut self, name: &str) -> Result<(), ExpressionProblem> {
        let Some(at) = self.names.iter().position(|n| *n == name) else {
            let near = cellpos_numeric::units::nearest(name, self.names.iter().copied());
            return Err(ExpressionProblem(format!(
                "`{name}` is not known here{}: what may stand here is {}",
                near.map_or_else(String::new, |n| format!(" (did you mean `{n}`?)")),
                self.names.join(", ")
            )));
        };
        self.program.names.push(at);
        self.push(Step::Name(at))
    }

    fn function(&mut self, name: &str, args: &[IC]) -> Result<(), ExpressionProblem> {
        // A name with empty parentheses is a name.
        if args.is_empty() && self.names.contains(&name) {
            return self.name(name);
        }
        let Some((_, f)) = OF_ONE.iter().find(|(n, _)| *n == name) else {
            let near = cellpos_numeric::units::nearest(name, FUNCTIONS.iter().copied());
            return Err(ExpressionProblem(format!(
                "there is no function `{name}`{}: there are {}",
                near.map_or_else(String::new, |n| format!(" (did you mean `{n}`?)")),
                FUNCTIONS.join(", ")
            )));
        };
        let [x] = args else {
            return Err(ExpressionProblem(format!(
                "`{name}` takes one number, not {}",
                args.len()
            )));
        };
        self.number(x)?;
        self.push(Step::One(*f))
    }
}

/// The parser reads `-a^2` as `(-a)^2`, people as `-(a^2)`: such a text is refused.
fn minus_before_power(text: &str) -> Result<(), ExpressionProblem> {
    let c: Vec<char> = text.chars().filter(|c| !c.is_whitespace()).collect();
    for (i, _) in c.iter().enumerate().filter(|(_, c)| **c == '-') {
        let before = i.checked_sub(1).and_then(|i| c.get(i));
        let exponent = i >= 2
            && matches!(before, Some('e' | 'E'))
            && c.get(i - 2)
                .is_some_and(|d| d.is_ascii_digit() || *d == '.');
        if exponent || before.is_some_and(|b| b.is_alphanumeric() || matches!(b, ')' | '_' | '.')) {
            continue;
        }
        let mut end = i + 1;
        while c
            .get(end)
            .is_some_and(|x| x.is_alphanumeric() || matches!(x, '_' | '.'))
        {
            end += 1;
        }
        if c.get(end) == Some(&'(') {
            let mut open = 0;
            while let Some(x) = c.get(end) {
                open += i32::from(*x == '(') - i32::from(*x == ')');
                end += 1;
                if open == 0 {
                    break;
                }
            }
        }
        if c.get(end) == Some(&'^') {
            let operand: String = c[i + 1..end].iter().collect();
            return Err(ExpressionProblem(format!(
                "`-{operand}^` can be read in two ways: write -({operand}^...) or (-{operand})^..."
            )));
        }
    }
    Ok(())
}

fn in_words(error: &fasteval3::Error) -> String {
    use fasteval3::Error;
    match error {
        Error::EOF | Error::EofWhileParsing(_) => {
            "it ends too early (a parenthesis that is not closed, an operator without its number)"
                .to_owned()
        }
        Error::UnparsedTokensRemaining(rest) => {
            format!("an operator is missing before `{rest}` (write 2*x, sin(x))")
        }
        Error::InvalidValue => "a number or a name is missing beside an operator".to_owned(),
        Error::Expected(what) => format!("{what} is expected"),
        Error::WrongArgs(what) => format!("wrong numbers of a function: {what}"),
        Error::TooLong | Error::TooDeep | Error::SlabOverflow => "it is too long".to_owned(),
        other => format!("{other}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NAMES: &[&str] = &["input", "output", "r"];

    fn value(text: &str, values: [f64; 3]) -> f64 {
        match Program::new(text, NAMES) {
            Ok(p) => p.value(&values),
            Err(ExpressionProblem(words)) => panic!("{words}"),
        }
    }

    #[test]
    fn an_expression_is_worth_what_the_field_reads_in_it() {
        let play = "max(input - r, min(input + r, output))";
        assert_eq!(value(play, [2.0, 0.0, 0.5]), 1.5);
        assert_eq!(value(play, [0.2, 0.0, 0.5]), 0.0);
        assert_eq!(value("1 - 2 - 3", [0.0; 3]), -4.0);
        assert_eq!(value("8/4/2", [0.0; 3]), 1.0);
        assert_eq!(value("2^3^2", [0.0; 3]), 512.0);
        assert_eq!(value("3 - input^2", [2.0, 0.0, 0.0]), -1.0);
        assert_eq!(value("(-input)^2", [2.0, 0.0, 0.0]), 4.0);
        assert_eq!(value("-input * 2", [2.0, 0.0, 0.0]), -4.0);
        assert_eq!(value("1e-3 * input", [2.0, 0.0, 0.0]), 2e-3);
        assert_eq!(value("(input > 1 && r <= 0) * 5", [2.0, 0.0, 0.0]), 5.0);
        assert_eq!(
            value("sign(input) * sqrt(abs(input))", [-4.0, 0.0, 0.0]),
            -2.0
        );
        assert_eq!(
            value("exp(ln(input)) / tanh(r)", [2.0, 0.0, 1e9]),
            2.0_f64.ln().exp()
        );
        assert_eq!(value("sign(input)", [0.0; 3]), 0.0);
        for x in [-1.7, 0.3, 2.9] {
            for y in [-2.0, 0.0, 2.0, 3.0, 7.0] {
                let direct = f64::powf(x, y);
                assert!((value("input^r", [x, 0.0, y]) - direct).abs() < 1e-12 * direct.abs());
            }
        }
    }

    #[test]
    fn what_is_wrong_with_an_expression_is_said_with_what_would_be_right() {
        let words = |text: &str| match Program::new(text, NAMES) {
            Ok(_) => panic!("{text} is taken"),
            Err(ExpressionProblem(words)) => words,
        };
        assert!(words("inpt * 2").contains("did you mean `input`?"));
        assert!(words("sqr(input)").contains("did you mean `sqrt`?"));
        assert!(words("2 input").contains("operator is missing before `input`"));
        assert!(words("max(input, 2").contains("ends too early"));
        assert!(words("input + * 2").contains("missing beside an operator"));
        assert!(words("-input^2").contains("two ways"));
        assert!(words("3 * -sqrt(input)^2").contains("two ways"));
        assert!(words("sqrt(1, 2)").contains("takes one number"));
        assert!(words("print(input)").contains("no function"));
    }
}
